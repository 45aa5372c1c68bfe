"""What can be refused before anything is read: missing packages, a port in use."""

from __future__ import annotations

import errno
import socket
from importlib.util import find_spec

from wheretolook.utils.errors import ConfigError, InUseError

EXTRAS = {"viser": "view", "rerun": "record"}


def require(package: str) -> None:
    """Raise a ConfigError that tells how to install viser or rerun, if it is missing."""
    if find_spec(package) is None:
        fix = f"Install it: pip install 'wheretolook[{EXTRAS[package]}]'."
        raise ConfigError(f"this needs the package {package}", fix=fix)


def check_port(host: str, port: int) -> None:
    """Raise an InUseError if a port is in use, a ConfigError if it is none, or the host is none of this machine's."""
    if not 0 <= port <= 65535:
        raise ConfigError("a port is a number from 0 to 65535", value=port, fix="Such as --port 8081.")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except PermissionError as error:
        fix = "Give another one: --port 8081."
        raise ConfigError("this port needs rights that you do not have", value=port, fix=fix) from error
    except socket.gaierror as error:
        raise ConfigError("there is no such host", value=host, fix="Such as --host 127.0.0.1.") from error
    except OSError as error:
        if error.errno == errno.EADDRNOTAVAIL:
            raise ConfigError("this machine has no such address", value=host, fix="Such as --host 0.0.0.0.") from error
        free = port + 1 if port < 65535 else 8080
        raise InUseError("this port is in use", value=port, fix=f"Give another one: --port {free}.") from error
