"""wheretolook: where to point a camera so that it knows where it is."""

__version__ = "0.1.0"
