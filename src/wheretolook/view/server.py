"""The page in the browser: one server, a session for each client, nothing but the scene."""

from __future__ import annotations

import contextlib
import io
import logging
import re
import threading
import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from wheretolook.utils.errors import ConfigError, InUseError
from wheretolook.view.checks import check_port, require
from wheretolook.view.shared import Shared
from wheretolook.view.state import ViewState

PORT = 8080
HOST = "127.0.0.1"
LOCAL = ("localhost", "127.0.0.1", "::1")  # names of this machine alone
HEADERS = ("Host", "Origin", "X-Forwarded-Host")

_log = logging.getLogger(__name__)


class Viewer:
    """Serves a scene until it is stopped. Raises as `check_port`; ConfigError if viser is not installed."""

    def __init__(
        self, shared: Shared, host: str = HOST, port: int = PORT, state: ViewState = ViewState(), dark: bool = False
    ) -> None:
        require("viser")
        check_port(host, port)
        self.shared = shared
        self.state = state
        self.dark = dark
        self.sessions: dict[int, Any] = {}
        self._lock = threading.Lock()
        self.server = _server(host, port, f"wheretolook · {shared.opened.name}")
        self.port = self.server.get_port()
        if port not in (0, self.port):  # somebody else took it meanwhile
            self.stop()
            raise InUseError("this port is in use", value=port, fix=f"Give another one: --port {port + 1}.")
        self.host = host
        self._view_from(shared)
        self.server.on_client_connect(self._joined)
        self.server.on_client_disconnect(self._left)

    @property
    def url(self) -> str:
        """Where the page is."""
        return f"http://{self._name}"

    @property
    def _name(self) -> str:
        host = "localhost" if self.host in ("0.0.0.0", "::", "127.0.0.1") else self.host
        return f"[{host}]:{self.port}" if ":" in host else f"{host}:{self.port}"

    def wait(self) -> None:
        """Serve until interrupted."""
        threading.Event().wait()

    def stop(self) -> None:
        """Serve no more."""
        for session in list(self.sessions.values()):
            session.close()
        self.shared.worker.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _view_from(self, shared: Shared) -> None:
        """Clients begin above one corner, so that all of the floor is in the picture."""
        low, high = shared.seen_box
        middle = (low + high) / 2
        size_m = float(np.linalg.norm(high - low))
        camera = self.server.initial_camera
        camera.far = max(1000.0, 20 * shared.size_m)
        camera.near = min(0.01, shared.size_m / 1000)
        camera.fov = np.radians(50)
        middle = middle + 0.07 * size_m * np.array([0.82, -0.57, 0.0])  # the panel is on the right
        camera.look_at = self.state.target or tuple(middle)
        camera.position = self.state.eye or tuple(middle + size_m * np.array([-0.5, -0.72, 0.95]))

    def _joined(self, client: Any) -> None:
        """Whoever joins gets a session; if theirs fails, others do not notice."""
        from wheretolook.view.player import Player
        from wheretolook.view.saving import PictureButton, WaypointList
        from wheretolook.view.session import Session

        try:
            path, headers = _request(self.server, client.client_id)
            if not self._may_look(headers):
                self._refuse(client, headers)
                return
            host = headers.get("Host", "") if re.fullmatch(r"[\w.:\[\]-]{1,255}", headers.get("Host", "")) else ""
            state = self.state
            problem = None
            try:
                state = ViewState.of_path(path) or state
            except ConfigError as error:
                problem = error
            session = Session(client, self.shared, replace(state), host or self._name)
            with self._lock:
                self.sessions[client.client_id] = session
            session.theme(self.dark)
            session.controls.dark.value = self.dark
            waypoints = WaypointList(session)
            PictureButton(session)
            if self.shared.paths:
                Player(session)
            if state.eye is not None and state.target is not None:
                client.camera.position = np.array(state.eye)
                client.camera.look_at = np.array(state.target)
            client.scene.on_click()(session.newest(lambda event: self._clicked(session, waypoints, event)))
            if problem is not None:
                session.failed(problem)
            if client.client_id not in self.server.get_clients():
                self._left(client)
        except Exception:
            _log.exception("a client could not be served")

    def _may_look(self, headers: Mapping[str, str]) -> bool:
        """Whether a client may look by its headers.

        A page of any other site, open in a browser here, can reach a server of this machine alone: the browser tells
        which it is. One that a proxy of ours brings here is that of the proxy's name.
        """
        if self.host not in LOCAL or "Origin" not in headers:
            return True
        try:
            site = urlsplit(headers["Origin"])
            return site.hostname in LOCAL or site.netloc == headers.get("X-Forwarded-Host")
        except ValueError:
            return False

    def _refuse(self, client: Any, headers: Mapping[str, str]) -> None:
        _log.warning(
            "a page of another site was refused: %.100r. Serve it by --host, if it is yours", headers["Origin"]
        )
        body = f"This address is served to pages of {', '.join(LOCAL)} alone, unless --host says otherwise."
        client.add_notification("Not shown", body, color="red")

    def _left(self, client: Any) -> None:
        with self._lock:
            session = self.sessions.pop(client.client_id, None)
        if session is not None:
            session.close()

    def _clicked(self, session: Any, waypoints: Any, event: Any) -> None:
        point = where_clicked(event.ray_origin, event.ray_direction, session.scenery.drawn_m)
        low, high = np.asarray(self.shared.opened.space.bounds)
        if point is None or not ((point[:2] >= low[:2]) & (point[:2] <= high[:2])).all():
            return
        point[2] = session.state.height
        if session.controls.placing.value:
            waypoints.add(point)
        else:
            session.go_to(point)


def where_clicked(origin: Any, direction: Any, height_m: float) -> np.ndarray | None:
    """Where a ray meets the level plane at a height, (3,) m; None if it does not."""
    start = np.asarray(origin, dtype=np.float64)
    along = np.asarray(direction, dtype=np.float64)
    if start.shape != (3,) or along.shape != (3,) or not np.isfinite([start, along]).all() or abs(along[2]) < 1e-9:
        return None
    distance = (height_m - start[2]) / along[2]
    found = start + distance * along
    return found if distance > 0 and np.isfinite(found).all() else None


def _request(server: Any, client_id: int) -> tuple[str, Mapping[str, str]]:
    """Path of a client's connection, in which a link's state stands, and its headers; or empty."""
    try:
        request = server._websock_server._live_connections[client_id].request
        return request.path, {name: request.headers.get_all(name)[0] for name in HEADERS if name in request.headers}
    except (AttributeError, KeyError):  # another viser keeps them elsewhere: links then open without their state
        return "", {}


def _server(host: str, port: int, label: str) -> Any:
    import viser

    class Server(viser.ViserServer):
        """A server that no client can open to the world: `share.viser.studio` is never asked."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    # a client may leave while something is drawn for it
    warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
    for name in ("websockets.server", "asyncio"):
        logging.getLogger(name).addFilter(_one_line)
    with contextlib.redirect_stdout(io.StringIO()):
        made = Server(host, port, label=label, verbose=False)
    made.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
    return made


class _OneLine(logging.Filter):
    """Tell of connections and messages that failed in a line, and at most one a second: a client that sends nonsense is
    no fault of ours, and may send much of it."""

    _told = -1.0

    def filter(self, record: logging.LogRecord) -> bool:
        if record.exc_info and record.exc_info[1] is not None:
            now = time.monotonic()
            if now - self._told < 1.0:
                return False
            self._told = now
            error = record.exc_info[1]
            record.msg = f"what a client sent was of no use: {type(error).__name__}: {error}"
            record.args = ()
            record.exc_info = None
            record.exc_text = None
        return True


_one_line = _OneLine()  # one for all servers of this process
