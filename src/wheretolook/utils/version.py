"""The version of this package, where everything below its root can read it."""

VERSION = "0.1.0"
