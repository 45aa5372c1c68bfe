"""The web server of the viewer: one page, one session per client."""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import re
import socket
import threading
import time
import warnings
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from wheretolook.utils.errors import ConfigError, InUseError
from wheretolook.view.page import Page
from wheretolook.view.session import Worker
from wheretolook.view.state import ViewState
from wheretolook.view.viewed_map import ViewedMap

LOCAL = ("localhost", "127.0.0.1", "::1")  # names of this machine, unreachable from others

_log = logging.getLogger(__name__)


def check_port(host: str, port: int) -> None:
    """Raise InUseError if a port is in use, ConfigError if this machine cannot serve at host and port."""
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        socket.create_server((host, port), family=family).close()
    except (OSError, OverflowError) as error:
        in_use = getattr(error, "errno", 0) == errno.EADDRINUSE
        kind = InUseError if in_use else ConfigError
        fix = f"Use another: --port {port + 1}." if in_use else "Use another, such as --host 0.0.0.0 --port 8081."
        raise kind(f"this address cannot be served: {error}", value=f"{host}:{port}", fix=fix) from error


class Viewer:
    """Serves a map until it is stopped. Raises as `check_port`."""

    def __init__(
        self,
        viewed: ViewedMap,
        host: str = "127.0.0.1",
        port: int = 8080,
        state: ViewState = ViewState(),
        dark: bool = False,
    ) -> None:
        check_port(host, port)
        self.viewed = viewed
        self.state = state
        self.dark = dark
        self.host = host
        self.worker = Worker()
        self.sessions: dict[int, Page] = {}
        self._lock = threading.Lock()
        self.server = _start_server(host, port, f"wheretolook · {viewed.name}")
        self.port = self.server.get_port()
        if port not in (0, self.port):  # taken since the check
            self.stop()
            raise InUseError("this port is in use", value=port, fix=f"Use another: --port {self.port}.")
        if host in ("0.0.0.0", "::", "127.0.0.1"):
            host = "localhost"
        elif ":" in host:
            host = f"[{host}]"
        self.address = f"{host}:{self.port}"
        self._place_camera()
        self.server.on_client_connect(self._client_joined)
        self.server.on_client_disconnect(self._client_left)

    def wait(self) -> None:
        """Serve until interrupted."""
        threading.Event().wait()

    def stop(self) -> None:
        """Stop serving."""
        for session in list(self.sessions.values()):
            session.close()
        self.worker.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _place_camera(self) -> None:
        """Place the initial camera above one corner, so that it sees the whole floor and most landmarks."""
        viewed = self.viewed
        space = viewed.bounds.copy()
        space[:, 2] = viewed.usual_m
        low = np.minimum(space[0], viewed.landmark_bounds[0])
        high = np.maximum(space[1], viewed.landmark_bounds[1])
        size_m = float(np.linalg.norm(high - low))
        center = (low + high) / 2 + 0.07 * size_m * np.array([0.82, -0.57, 0.0])  # the panel covers the right
        camera = self.server.initial_camera
        camera.far = max(1000.0, 20 * viewed.size_m)
        camera.near = min(0.01, viewed.size_m / 1000)
        camera.fov = np.radians(50)
        camera.look_at = self.state.target or tuple(center)
        camera.position = self.state.eye or tuple(center + size_m * np.array([-0.5, -0.72, 0.95]))

    def _client_joined(self, client: Any) -> None:
        """Start a session, unless the page is of another site; one that fails does not affect others."""
        try:
            path, headers = _request(self.server, client.client_id)
            if self._is_allowed(headers):
                self._start_session(client, path, headers.get("Host", ""))
                return
            _log.warning("rejected a page of another site: %.100r. Serve your own site by --host", headers["Origin"])
            text = f"This address is served to pages of {', '.join(LOCAL)} only; see --host."
            client.add_notification("Not shown", text, color="red")
        except Exception:
            _log.exception("a client could not be served")

    def _start_session(self, client: Any, path: str, host: str) -> None:
        problem = None
        state = self.state
        try:
            state = ViewState.of_path(path) or state
        except ConfigError as error:
            problem = error
        address = host if re.fullmatch(r"[\w.:\[\]-]{1,255}", host) else self.address
        page = Page(client, self.viewed, self.worker, state, address, self.dark)
        with self._lock:
            self.sessions[client.client_id] = page
        if problem is not None:
            page.show_error(problem)
        if client.client_id not in self.server.get_clients():
            self._client_left(client)

    def _is_allowed(self, headers: Mapping[str, str]) -> bool:
        """Test whether a client may see the page, by the headers of its request.

        A server on a local address is reachable from pages of other sites that are open in a browser on this machine;
        the browser sends the page's origin. Pages behind an own proxy have the proxy's name.
        """
        if self.host not in LOCAL or "Origin" not in headers:
            return True
        try:
            site = urlsplit(headers["Origin"])
            return site.hostname in LOCAL or (bool(site.netloc) and site.netloc == headers.get("X-Forwarded-Host"))
        except ValueError:
            return False

    def _client_left(self, client: Any) -> None:
        with self._lock:
            session = self.sessions.pop(client.client_id, None)
        if session is not None:
            session.close()


def _request(server: Any, client_id: int) -> tuple[str, Mapping[str, str]]:
    """Return path and headers of a client's request, from private fields of viser."""
    try:
        request = server._websock_server._live_connections[client_id].request
        return request.path, {
            name: request.headers.get_all(name)[0]
            for name in ("Host", "Origin", "X-Forwarded-Host")
            if name in request.headers
        }
    except (AttributeError, KeyError):  # another version of viser; links then open without their state
        return "", {}


def _start_server(host: str, port: int, label: str) -> Any:
    import viser

    class Server(viser.ViserServer):
        """A server that clients cannot publish through `share.viser.studio`."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    # a client may leave while something is drawn for it
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    for name in ("websockets.server", "asyncio"):
        logging.getLogger(name).addFilter(_one_line)
    with contextlib.redirect_stdout(io.StringIO()):
        server = Server(host, port, label=label, verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
    return server


class _OneLine(logging.Filter):
    """Shortens errors caused by invalid messages of clients to one line, and at most one per second."""

    _reported = -1.0

    def filter(self, record: logging.LogRecord) -> bool:
        if record.exc_info and record.exc_info[1] is not None:
            now = time.monotonic()
            if now - self._reported < 1.0:
                return False
            self._reported = now
            error = record.exc_info[1]
            record.msg = f"invalid message from a client: {type(error).__name__}: {error}"
            record.args = ()
            record.exc_info = None
            record.exc_text = None
        return True


_one_line = _OneLine()  # one filter, added once however many servers run
