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
from importlib.util import find_spec
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from wheretolook.utils.errors import ConfigError, InUseError
from wheretolook.view.shared import Shared
from wheretolook.view.state import ViewState

PORT = 8080
HOST = "127.0.0.1"
LOCAL = ("localhost", "127.0.0.1", "::1")  # names of this machine, unreachable from others
HEADERS = ("Host", "Origin", "X-Forwarded-Host")
EXTRAS = {"viser": "view", "rerun": "record"}

_log = logging.getLogger(__name__)


def require(package: str) -> None:
    """Raise ConfigError with the command that installs viser or rerun if it is missing."""
    if find_spec(package) is None:
        fix = f"Install it: pip install 'wheretolook[{EXTRAS[package]}]'."
        raise ConfigError(f"this needs the package {package}", fix=fix)


def check_port(host: str, port: int) -> None:
    """Raise InUseError if a port is in use, ConfigError if this machine cannot serve at host and port."""
    if not 0 <= port <= 65535:
        raise ConfigError("a port is a number from 0 to 65535", value=port, fix="Such as --port 8081.")
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise _in_use(port) from error
        fix = "Such as --host 0.0.0.0 --port 8081."
        raise ConfigError(f"this address cannot be served: {error}", value=f"{host}:{port}", fix=fix) from error


def _in_use(port: int) -> InUseError:
    free = port + 1 if port < 65535 else PORT
    return InUseError("this port is in use", value=port, fix=f"Use another: --port {free}.")


class Viewer:
    """Serves a map until it is stopped. Raises as `check_port`, and ConfigError if viser is not installed."""

    def __init__(
        self, shared: Shared, host: str = HOST, port: int = PORT, state: ViewState = ViewState(), dark: bool = False
    ) -> None:
        require("viser")
        check_port(host, port)
        self.shared = shared
        self.state = state
        self.dark = dark
        self.host = host
        self.sessions: dict[int, Any] = {}
        self._lock = threading.Lock()
        self.server = _start_server(host, port, f"wheretolook · {shared.viewed.name}")
        self.port = self.server.get_port()
        if port not in (0, self.port):  # taken since the check
            self.stop()
            raise _in_use(port)
        self._place_camera()
        self.server.on_client_connect(self._client_joined)
        self.server.on_client_disconnect(self._client_left)

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{self._address}"

    @property
    def _address(self) -> str:
        host = "localhost" if self.host in ("0.0.0.0", "::", HOST) else self.host
        return f"[{host}]:{self.port}" if ":" in host else f"{host}:{self.port}"

    def wait(self) -> None:
        """Serve until interrupted."""
        threading.Event().wait()

    def stop(self) -> None:
        """Stop serving."""
        for session in list(self.sessions.values()):
            session.close()
        self.shared.worker.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _place_camera(self) -> None:
        """Place the initial camera above one corner, so that it sees the whole floor."""
        low, high = self.shared.bounding_box
        size_m = float(np.linalg.norm(high - low))
        center = (low + high) / 2 + 0.07 * size_m * np.array([0.82, -0.57, 0.0])  # the panel covers the right
        camera = self.server.initial_camera
        camera.far = max(1000.0, 20 * self.shared.size_m)
        camera.near = min(0.01, self.shared.size_m / 1000)
        camera.fov = np.radians(50)
        camera.look_at = self.state.target or tuple(center)
        camera.position = self.state.eye or tuple(center + size_m * np.array([-0.5, -0.72, 0.95]))

    def _client_joined(self, client: Any) -> None:
        """Start a session; one that fails does not affect others."""
        try:
            path, headers = _request(self.server, client.client_id)
            if self._is_allowed(headers):
                self._start_session(client, path, headers.get("Host", ""))
            else:
                self._reject(client, headers)
        except Exception:
            _log.exception("a client could not be served")

    def _start_session(self, client: Any, path: str, host: str) -> None:
        from wheretolook.view.player import Player
        from wheretolook.view.saving import PictureButton, WaypointList
        from wheretolook.view.session import Session

        problem = None
        try:
            state = ViewState.of_path(path) or self.state
        except ConfigError as error:
            state = self.state
            problem = error
        session = Session(
            client, self.shared, state, host if re.fullmatch(r"[\w.:\[\]-]{1,255}", host) else self._address
        )
        with self._lock:
            self.sessions[client.client_id] = session
        session.set_theme(self.dark)
        session.controls.dark.value = self.dark
        waypoints = WaypointList(session)
        PictureButton(session)
        if self.shared.paths:
            Player(session)
        if state.eye is not None and state.target is not None:
            client.camera.position = np.array(state.eye)
            client.camera.look_at = np.array(state.target)
        client.scene.on_click()(session.callback(lambda event: self._clicked(session, waypoints, event)))
        if problem is not None:
            session.show_error(problem)
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

    def _reject(self, client: Any, headers: Mapping[str, str]) -> None:
        _log.warning("rejected a page of another site: %.100r. Serve your own site by --host", headers["Origin"])
        text = f"This address is served to pages of {', '.join(LOCAL)} only; see --host."
        client.add_notification("Not shown", text, color="red")

    def _client_left(self, client: Any) -> None:
        with self._lock:
            session = self.sessions.pop(client.client_id, None)
        if session is not None:
            session.close()

    def _clicked(self, session: Any, waypoints: Any, event: Any) -> None:
        point = intersect_plane(event.ray_origin, event.ray_direction, session.scenery.floor_m)
        low, high = np.asarray(self.shared.viewed.space.bounds)
        if point is None or not ((point[:2] >= low[:2]) & (point[:2] <= high[:2])).all():
            return
        point[2] = session.state.height
        if session.controls.placing.value:
            waypoints.add(point)
        else:
            session.place.select(point)


def intersect_plane(origin: Any, direction: Any, height_m: float) -> np.ndarray | None:
    """Return where a ray meets the horizontal plane at a height, (3,) m; None if it does not."""
    start = np.asarray(origin, dtype=np.float64)
    axis = np.asarray(direction, dtype=np.float64)
    if start.shape != (3,) or axis.shape != (3,) or not np.isfinite([start, axis]).all() or abs(axis[2]) < 1e-9:
        return None
    distance = (height_m - start[2]) / axis[2]
    point = start + distance * axis
    return point if distance > 0 and np.isfinite(point).all() else None


def _request(server: Any, client_id: int) -> tuple[str, Mapping[str, str]]:
    """Return path and headers of a client's request, from private fields of viser."""
    try:
        request = server._websock_server._live_connections[client_id].request
        return request.path, {name: request.headers.get_all(name)[0] for name in HEADERS if name in request.headers}
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
