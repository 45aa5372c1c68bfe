"""The page of one client: scene, selected location and paths, and what connects them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from wheretolook.view import drawing
from wheretolook.view.controls import value_of
from wheretolook.view.location import LocationView
from wheretolook.view.scenery import Scenery
from wheretolook.view.session import Session, once
from wheretolook.view.state import ViewState
from wheretolook.view.viewed_map import ViewedMap
from wheretolook.view.worker import LATER, SOON, Worker

if TYPE_CHECKING:
    from viser import ClientHandle


class Page(Session):
    """The session of one client with everything that its page shows."""

    def __init__(
        self, client: ClientHandle, viewed: ViewedMap, worker: Worker, state: ViewState, host: str, dark: bool
    ) -> None:
        super().__init__(client, viewed, worker, state, host)
        self.scenery = Scenery(self)
        self.place = LocationView(self)
        self._connect()
        self.controls.dark.value = dark
        self.set_theme(dark)
        if state.eye is not None and state.target is not None:
            client.camera.position = np.array(state.eye)
            client.camera.look_at = np.array(state.target)
        self.scenery.draw_paths()
        self.draw_scene()
        self.fill_floor()
        if state.place is not None:
            self.place.select(np.array(state.place), None if state.yaw is None else (state.yaw, state.pitch or 0.0))

    def _connect(self) -> None:
        c = self.controls
        for handle in (c.method, c.occlusion):
            self.on(handle, self._method_changed)
        for handle in (c.height, c.threshold):
            self.on(handle, self._floor_changed)
        self.on(c.cut, self._cut_changed)
        self.on(c.n, self._n_changed)
        for handle in (c.inside, *c.layers.values()):
            self.on(handle, self._layers_changed)
        self.on(c.limits, self.draw_labels)
        self.on(c.dark, lambda: self.set_theme(bool(c.dark.value)))
        self.client.camera.on_update(self.callback(lambda _: self._camera_moved()))
        clicks: Any = self.scene.on_click()  # typed for plain functions, takes coroutines too
        clicks(self.callback(self._clicked))

    def set_theme(self, dark: bool) -> None:
        """Switch between light and dark."""
        self.scene.set_background_image(drawing.DARK_BACKGROUND if dark else None, format="png")
        self.client.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False, control_width="large")

    def _method_changed(self) -> None:
        self.update(method=value_of(self.controls.method), occlusion=value_of(self.controls.occlusion))
        self.fill_floor()
        self.place.refresh()
        self.draw_labels()

    def _n_changed(self) -> None:
        self.update(n=int(self.controls.n.value))
        self.controls.view.max = max(2, self.state.n)
        self.place.refresh()

    def _floor_changed(self) -> None:
        before = self.state.threshold
        self.update(height=value_of(self.controls.height), threshold=value_of(self.controls.threshold))
        self.fill_floor()
        if self.state.threshold != before:
            self.draw_labels()

    def _cut_changed(self) -> None:
        self.update(cut=float(self.controls.cut.value))
        self._layers_changed()

    def _layers_changed(self) -> None:
        self.submit("scene", SOON, once(self.draw_scene))

    def _camera_moved(self) -> None:
        camera = self.client.camera
        eye = tuple(map(float, camera.position))
        target = tuple(map(float, camera.look_at))
        if np.isfinite((eye, target)).all():
            self.update(eye=eye, target=target)
            self.submit("state", LATER, once(self.show_state))
        self.place.camera_moved()

    def _clicked(self, event: Any) -> None:
        """Select the clicked location of the floor."""
        point = intersect_plane(event.ray_origin, event.ray_direction, self.scenery.floor_m)
        low, high = self.viewed.bounds[:, :2]
        if point is None or not ((point[:2] >= low) & (point[:2] <= high)).all():
            return
        point[2] = self.state.height
        self.place.select(point)

    def draw_scene(self) -> None:
        """Draw mesh, landmarks, mapping cameras and labels."""
        self.scenery.draw()
        if not self.controls.inside.value:
            self.draw_labels()

    def fill_floor(self) -> None:
        """Queue scoring and colouring of the floor."""
        self.submit("floor", LATER, self.scenery.fill_floor(self.state))
        self.show_state()

    def draw_labels(self) -> None:
        """Queue drawing of the labels."""
        self.submit("labels", SOON, self.scenery.draw_labels(self.state))


def intersect_plane(origin: Any, direction: Any, height_m: float) -> np.ndarray | None:
    """Return where a ray meets the horizontal plane at a height, (3,) m; None if it does not."""
    start = np.asarray(origin, dtype=np.float64)
    axis = np.asarray(direction, dtype=np.float64)
    if start.shape != (3,) or axis.shape != (3,) or not np.isfinite([start, axis]).all() or abs(axis[2]) < 1e-9:
        return None
    distance = (height_m - start[2]) / axis[2]
    point = start + distance * axis
    return point if distance > 0 and np.isfinite(point).all() else None
