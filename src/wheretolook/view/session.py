"""State, computations and drawing of one browser client."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import replace
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import WhereToLookError
from wheretolook.view import drawing
from wheretolook.view.controls import Controls, check_value, value_of
from wheretolook.view.level_of_detail import LevelOfDetail
from wheretolook.view.location import LocationView
from wheretolook.view.scenery import FEWER_LANDMARKS, Scenery
from wheretolook.view.shared import Shared
from wheretolook.view.state import ViewState
from wheretolook.view.worker import LATER, NOW, SOON, Worker

if TYPE_CHECKING:
    from viser import ClientHandle

    from wheretolook.select.where_to_look import WhereToLook

_log = logging.getLogger(__name__)

HEADROOM_M = 0.35  # above the floor, where a mesh is cut by default
NOTICE_S = 0.5  # minimum time between two error notifications


class Session:
    """One client. Its callbacks record choices in its own thread; computations run in the shared worker."""

    def __init__(self, client: ClientHandle, shared: Shared, state: ViewState, host: str) -> None:
        self.client = client
        self.shared = shared
        self.host = host
        self.scene = client.scene
        self.viewed = shared.viewed
        self.state = shared.complete(state)
        if state.cut is None and shared.viewed.mesh is not None:
            top = float(shared.viewed.mesh.bounds[1, 2])
            self.state = replace(self.state, cut=min((self.state.height or 0.0) + HEADROOM_M, top))
        self.closed = False
        self._lock = Lock()
        self._inbox = Worker(f"client {client.client_id}")
        self._notified = -NOTICE_S  # time of the last error notification
        self.controls = Controls(client.gui, shared, self.state)
        self.scenery = Scenery(client.scene, shared, self.controls)
        self.place = LocationView(self)
        self._detail = LevelOfDetail(self._set_level, len(FEWER_LANDMARKS))
        self._connect()
        self.draw_scene()
        self.fill_floor()
        if state.place is not None:
            self.place.select(np.array(state.place), None if state.yaw is None else (state.yaw, state.pitch or 0.0))

    @property
    def selector(self) -> WhereToLook:
        """The view selector of the chosen method and occlusion model; for the worker thread."""
        return self.viewed.selector(self.state.method, self.state.occlusion)

    def _connect(self) -> None:
        c = self.controls
        for handle in (c.method, c.occlusion):
            self.on(handle, self._method_changed)
        for handle in (c.height, c.threshold):
            self.on(handle, self._floor_changed)
        self.on(c.cut, self._cut_changed)
        self.on(c.n, self._n_changed)
        for layer in c.layers.values():
            self.on(layer, self.draw_scene)
        self.on(c.limits, self.draw_labels)
        self.on(c.dark, lambda: self.set_theme(bool(c.dark.value)))
        self.client.camera.on_update(self.callback(lambda _: self._camera_moved()))

    def on(self, handle: Any, action: Callable[[], None], event: str = "on_update", by_hand: bool = False) -> None:
        """Call `action` when a control changes, optionally only if the client changed it; errors go to the client."""
        previous = [getattr(handle, "value", None)]

        def checked(_: object) -> None:
            check_value(handle, previous[0])
            previous[0] = getattr(handle, "value", None)
            action()

        getattr(handle, event)(self.callback(checked, by_hand))

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
                self._inbox.submit(self.client.client_id, kind, NOW, _once(lambda: action(event)), self.show_error)

        return enqueue

    def submit(self, kind: str, urgency: int, steps: Iterator[object]) -> None:
        """Queue a computation for this client in place of the pending one of that kind."""
        if not self.closed:
            self.shared.worker.submit(self.client.client_id, kind, urgency, steps, self.show_error)

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
        if self.place.location is None:
            self.controls.summary.content = drawing.escape_markdown(text)

    def update(self, **changes: Any) -> None:
        """Change fields of the state; thread-safe."""
        with self._lock:
            self.state = replace(self.state, **changes)

    def set_theme(self, dark: bool) -> None:
        """Switch between light and dark."""
        self.client.scene.set_background_image(drawing.DARK_BACKGROUND if dark else None, format="png")
        self.client.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False, control_width="large")

    def _method_changed(self) -> None:
        c = self.controls
        state = self.state
        self.update(method=value_of(c.method, state.method), occlusion=value_of(c.occlusion, state.occlusion))
        self.fill_floor()
        self.place.refresh()
        self.draw_labels()

    def _n_changed(self) -> None:
        self.update(n=int(self.controls.n.value))
        self.controls.view.max = max(2, self.state.n)
        self.place.refresh()

    def _floor_changed(self) -> None:
        c = self.controls
        before = self.state
        threshold = float(value_of(c.threshold, before.threshold))
        self.update(height=value_of(c.height, before.height), threshold=threshold)
        self.fill_floor()
        if before.threshold != threshold:
            self.draw_labels()

    def _cut_changed(self) -> None:
        self.update(cut=float(self.controls.cut.value))
        self.redraw()

    def _set_level(self, level: int) -> None:
        if not self.closed:
            with self.client.atomic():
                self.scenery.set_level(level)

    def _camera_moved(self) -> None:
        camera = self.client.camera
        eye = tuple(map(float, camera.position))
        target = tuple(map(float, camera.look_at))
        if np.isfinite((eye, target)).all():
            self._detail.moved(eye, target)  # type: ignore[arg-type]
            self.update(eye=eye, target=target)
            self.submit("state", LATER, _once(self.show_state))
        self.place.camera_moved()

    def redraw(self) -> None:
        """Queue `draw_scene`."""
        self.submit("scene", SOON, _once(self.draw_scene))

    def draw_scene(self) -> None:
        """Draw mesh, landmarks, mapping cameras and labels."""
        inside = bool(self.controls.inside.value)
        self.scenery.draw(self.state, inside)
        if not inside:
            self.draw_labels()

    def fill_floor(self) -> None:
        """Queue scoring and colouring of the floor."""
        self.submit("floor", LATER, self.scenery.fill_floor(self.state))
        self.show_state()

    def draw_labels(self) -> None:
        """Queue drawing of the labels."""
        self.submit("labels", SOON, self.scenery.draw_labels(self.state))

    def add_frustum(
        self, name: str, wxyz: Float, position: Float, markers: float, color: tuple[int, int, int], **options: Any
    ) -> None:
        """Draw a camera frustum, `markers` times as large as a marker."""
        camera = self.viewed.camera
        self.scene.add_camera_frustum(
            name,
            self.place.fov,
            camera.width / camera.height,
            scale=markers * self.shared.marker_m,
            color=color,
            wxyz=wxyz,
            position=position,
            thickness_units="screen",
            cast_shadow=False,
            receive_shadow=False,
            **options,
        )

    def show_state(self) -> None:
        """Show the state as text and link."""
        text = self.state.text()
        if self.controls.state.value != text:
            self.controls.state.value = text
            self.controls.link.content = f"[A link to this view]({self.state.link(self.host)})"

    def close(self) -> None:
        """Stop all work for this client."""
        self.closed = True
        self._inbox.stop(wait=False)
        self.shared.worker.forget(self.client.client_id)


def _once(action: Callable[[], None]) -> Iterator[None]:
    action()
    yield
