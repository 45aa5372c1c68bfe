"""State, controls and queued work of one browser client."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import replace
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from wheretolook.geometry.poses import Float, quaternion_from_rotation
from wheretolook.utils.errors import ConfigError, WhereToLookError
from wheretolook.view import drawing
from wheretolook.view.controls import Controls, value_of
from wheretolook.view.scores import ScoredLocation
from wheretolook.view.state import ViewState
from wheretolook.view.viewed_map import ViewedMap
from wheretolook.view.worker import NOW, Worker

if TYPE_CHECKING:
    from viser import ClientHandle

    from wheretolook.select.where_to_look import WhereToLook

_log = logging.getLogger(__name__)

HEADROOM_M = 0.35  # above the floor, where a mesh is cut by default
NOTICE_S = 0.5  # minimum time between two error notifications


class Session:
    """One client. Its callbacks record choices in its own thread; computations run in the shared worker."""

    def __init__(self, client: ClientHandle, viewed: ViewedMap, worker: Worker, state: ViewState, host: str) -> None:
        self.client = client
        self.scene = client.scene
        self.viewed = viewed
        self.worker = worker
        self.host = host
        self.state = viewed.complete(state)
        if state.cut is None and viewed.mesh is not None:
            top = float(viewed.mesh.bounds[1, 2])
            self.state = replace(self.state, cut=min((self.state.height or 0.0) + HEADROOM_M, top))
        self.location: ScoredLocation | None = None  # selected
        self.controls = Controls(client.gui, viewed, self.state)
        self.closed = False
        self._lock = Lock()
        self._inbox = Worker(f"client {client.client_id}")
        self._notified = -NOTICE_S  # time of the last error notification

    @property
    def selector(self) -> WhereToLook:
        """The view selector of the chosen method and occlusion model; for the worker thread."""
        return self.viewed.selector(self.state.method, self.state.occlusion)

    @property
    def fov(self) -> float:
        """The vertical field of view of the map's camera in radians, without distortion."""
        camera = self.viewed.camera
        return 2 * float(np.arctan(camera.height / 2 / camera.mean_focal_px))

    def on(self, handle: Any, action: Callable[[], None], by_hand: bool = False) -> None:
        """Call `action` when a control changes or is clicked, optionally only if the client changed it.

        Errors go to the client; invalid values are replaced by the previous one.
        """
        previous = [getattr(handle, "value", None)]

        def checked(_: object) -> None:
            try:
                previous[0] = value_of(handle)
            except ConfigError:
                handle.value = previous[0]
                raise
            action()

        event = handle.on_click if hasattr(handle, "on_click") else handle.on_update
        event(self.callback(checked, by_hand))

    def callback(
        self, action: Callable[[Any], None], by_hand: bool = False
    ) -> Callable[[Any], Coroutine[Any, Any, None]]:
        """Wrap an action on an event for viser: it runs in this client's thread, for the newest event only.

        viser runs plain functions in threads that all clients share, where one client's flood of events would delay
        the others; so this is a coroutine.
        """
        kind = object()

        async def enqueue(event: Any) -> None:
            if not (by_hand and event.client is None):
                self._inbox.submit(self.client.client_id, kind, NOW, once(lambda: action(event)), self.show_error)

        return enqueue

    def submit(self, kind: str, urgency: int, steps: Iterator[object]) -> None:
        """Queue a computation for this client in place of the pending one of that kind."""
        if not self.closed:
            self.worker.submit(self.client.client_id, kind, urgency, steps, self.show_error)

    def show_error(self, error: Exception) -> None:
        """Notify the client of an error, at most once every NOTICE_S."""
        now = time.monotonic()
        if self.closed or now - self._notified < NOTICE_S:
            return
        self._notified = now
        text = str(error)
        if not isinstance(error, WhereToLookError):
            _log.error("the viewer failed", exc_info=error)
            text = f"{type(error).__name__}: {error}. See the terminal."
        self.client.add_notification("That did not work", text, color="red", auto_close_seconds=15)
        if self.location is None:
            self.controls.summary.content = drawing.escape_markdown(text)

    def update(self, **changes: Any) -> None:
        """Change fields of the state; thread-safe."""
        with self._lock:
            self.state = replace(self.state, **changes)

    def show_state(self) -> None:
        """Show the state as text and link."""
        text = self.state.text()
        if self.controls.state.value != text:
            self.controls.state.value = text
            self.controls.link.content = f"[A link to this view]({self.state.link(self.host)})"

    def add_points(self, name: str, points: Float, colors: Any, size_m: float, visible: bool = True) -> None:
        """Draw points (N, 3) m, or nothing without any.

        Coordinates are sent relative to their mean, since single precision is coarse far away.
        """
        if len(points) == 0:
            self.scene.remove_by_name(name)
            return
        center = points.mean(0)
        self.scene.add_point_cloud(
            name,
            (points - center).astype(np.float32),
            colors,
            point_size=size_m,
            point_shape="circle",
            precision="float32",
            position=center,
            point_shading="flat",
            visible=visible,
        )

    def add_lines(self, name: str, segments: Float, colors: Any, thickness: float) -> None:
        """Draw lines between pairs of points (S, 2, 3) m, in one colour or those of their ends (S, 2, 3)."""
        self.scene.add_line_segments(name, segments, colors, thickness=thickness, thickness_units="screen")

    def add_frustum(self, name: str, pose: Float, markers: float, color: tuple[int, int, int], **options: Any) -> None:
        """Draw the frustum of a camera pose (3, 4), `markers` times as large as a marker."""
        camera = self.viewed.camera
        rotation = pose[:, :3].T
        self.scene.add_camera_frustum(
            name,
            self.fov,
            camera.width / camera.height,
            scale=markers * self.viewed.marker_m,
            color=color,
            wxyz=quaternion_from_rotation(rotation),
            position=-rotation @ pose[:, 3],
            thickness_units="screen",
            cast_shadow=False,
            receive_shadow=False,
            **options,
        )

    def close(self) -> None:
        """Stop all work for this client."""
        self.closed = True
        self._inbox.stop(wait=False)
        self.worker.forget(self.client.client_id)


def once(action: Callable[[], None]) -> Iterator[None]:
    """Make a job of one step."""
    action()
    yield
