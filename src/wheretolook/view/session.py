"""One who looks: what was chosen, what is computed for it, and what is drawn. Nobody else's choices change it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import replace
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from wheretolook.geometry.camera_turns import pan_tilt_angles
from wheretolook.geometry.lattices import axes_of_angles
from wheretolook.geometry.poses import Float, poses_looking_along, quaternion_from_rotation, rotation_from_quaternion
from wheretolook.utils.errors import ConfigError, TableError, WhereToLookError
from wheretolook.view import drawing
from wheretolook.view.controls import build, check_value, value_of
from wheretolook.view.scenery import FEWER, Scenery
from wheretolook.view.scores import Place, landmarks_seen, look_around, report_of
from wheretolook.view.shared import Shared
from wheretolook.view.state import ViewState
from wheretolook.view.texts import plain
from wheretolook.view.turning import Turning
from wheretolook.view.worker import LATER, NOW, SOON, Worker

if TYPE_CHECKING:
    from viser import ClientHandle

_log = logging.getLogger(__name__)

IN_THE_WAY = ("/sphere", "/view", "/views", "/turn", "/seen")
"""What stands in the way of one who looks from the place itself."""

NOTICE_S = 0.5  # at least, between two notices of what went wrong

PATH_COLORS = ((120, 120, 120), (213, 94, 0), (0, 114, 178), (0, 158, 115), (204, 121, 167))


class Session:
    """What one client sees. Callbacks note what was chosen; all computing is the worker's."""

    def __init__(self, client: ClientHandle, shared: Shared, state: ViewState, host: str) -> None:
        self.client = client
        self.shared = shared
        self.host = host
        self.scene = client.scene
        self.opened = shared.opened
        method = state.method if state.method in self.opened.methods else self.opened.methods[0]
        occlusion = state.occlusion if state.occlusion in self.opened.occlusions else self.opened.occlusions[0]
        height = shared.usual_m if state.height is None else state.height
        if state.cut is None and self.opened.mesh is not None:
            state = replace(state, cut=min(height + 0.35, float(self.opened.mesh.bounds[1, 2])))
        self.state = replace(state, method=method, occlusion=occlusion, height=height)
        self.place: Place | None = None
        self.axis: Float | None = None
        self.closed = False
        self._lock = Lock()
        self._inbox = Worker(f"client {client.client_id}")
        self._failed = -NOTICE_S  # when this client was told what went wrong
        self._follows = 0.0  # when the browser's camera was last put somewhere by the program
        self._gizmo: Any = None
        self._outside: Any = None  # where the scene was seen from before one stood in it
        self.controls = build(client.gui, shared, self.state)
        self.scenery = Scenery(client.scene, shared, self.controls)
        self._turning_camera = Turning(self._thin, len(FEWER))
        self._connect()
        self.draw_scene()
        self.fill_floor()
        if state.place is not None:
            self.go_to(np.array(state.place), None if state.yaw is None else (state.yaw, state.pitch or 0.0))

    # -- what is chosen ------------------------------------------------------------------------------------------------

    def on(self, handle: Any, then: Callable[[], None], event: str = "on_update", by_hand: bool = False) -> None:
        """Do something when a control changes, on request only by hand, not by the program.

        What fails is told to this client, and to nobody else.
        """

        before = [getattr(handle, "value", None)]

        def checked(_: object) -> None:
            check_value(handle, before[0])
            before[0] = getattr(handle, "value", None)
            then()

        getattr(handle, event)(self.newest(checked, by_hand))

    def newest(self, then: Callable[[Any], None], by_hand: bool = False) -> Callable[[Any], Coroutine[Any, Any, None]]:
        """A callback for viser: does something with an event in the thread of this client, unless a newer one has come.

        A function that is no coroutine viser would queue for each message, in threads that all clients share: one that
        floods would hold up the others.
        """
        kind = object()

        async def noted(event: Any) -> None:
            if not (by_hand and event.client is None):
                self._inbox.submit(self.client.client_id, kind, NOW, _once(lambda: then(event)), self.failed)

        return noted

    def failed(self, error: Exception) -> None:
        """Tell this client what went wrong, unless it was just told of something: all it sends may be wrong."""
        now = time.monotonic()
        if self.closed or now - self._failed < NOTICE_S:
            return
        self._failed = now
        if isinstance(error, WhereToLookError):
            body = str(error)
        else:
            _log.error("the viewer failed", exc_info=error)
            body = f"{type(error).__name__}: {error}. The terminal tells more."
        self.client.add_notification("That did not work", body, color="red", auto_close_seconds=15)
        if self.place is None:
            self.controls.told.content = plain(body)

    def note(self, **changes: Any) -> None:
        """Change the state; callbacks come in several threads."""
        with self._lock:
            self.state = replace(self.state, **changes)

    def submit(self, kind: str, urgency: int, steps: Iterator[object]) -> None:
        """Compute something for this client, in place of what of that kind is still to be done."""
        if not self.closed:
            self.shared.worker.submit(self.client.client_id, kind, urgency, steps, self.failed)

    def _connect(self) -> None:
        c = self.controls
        for handle in (c.method, c.occlusion):
            self.on(handle, self._chosen)
        for handle in (c.height, c.threshold):
            self.on(handle, self._slid)
        self.on(c.cut, self._cut)
        self.on(c.n, self._chosen_n)
        self.on(c.view, lambda: self.show_best(int(c.view.value) - 1))
        for handle in (c.yaw, c.pitch):
            self.on(handle, self._turned, by_hand=True)
        self.on(c.through, self._look_through)
        for name in c.shown:
            self.on(c.shown[name], self.draw_scene)
        self.on(c.limits, self.judge)
        self.on(c.dark, lambda: self.theme(bool(c.dark.value)))
        self.client.camera.on_update(self.newest(lambda _: self._camera_moved()))

    def theme(self, dark: bool) -> None:
        """Light or dark; the ground of the dark scene is grey, since low scores are dark themselves."""
        self.client.scene.set_background_image(drawing.DARK_GROUND if dark else None, format="png")
        self.client.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False, control_width="large")

    def _chosen(self) -> None:
        c = self.controls
        known = self.state
        self.note(method=value_of(c.method, known.method), occlusion=value_of(c.occlusion, known.occlusion))
        self.fill_floor()
        if self.place is not None:
            self.go_to(self.place.position, self._angles())
        self.judge()

    def _chosen_n(self) -> None:
        self.note(n=int(self.controls.n.value))
        self.controls.view.max = max(2, self.state.n)
        if self.place is not None:
            self.go_to(self.place.position, self._angles())

    def _slid(self) -> None:
        c = self.controls
        before = self.state
        height = value_of(c.height, before.height)
        threshold = value_of(c.threshold, before.threshold)
        self.note(height=height, threshold=float(threshold))
        self.fill_floor()
        if before.threshold != self.state.threshold:
            self.judge()

    def _cut(self) -> None:
        self.note(cut=float(self.controls.cut.value))
        self.submit("scene", SOON, _once(self.draw_scene))

    def _turned(self) -> None:
        self.turn_to(
            axes_of_angles((value_of(self.controls.yaw, 0.0), value_of(self.controls.pitch, 0.0))), sliders=True
        )

    def _angles(self) -> tuple[float, float] | None:
        c = self.controls
        return None if self.axis is None else (float(value_of(c.yaw, 0.0)), float(value_of(c.pitch, 0.0)))

    def _look_through(self) -> None:
        """Stand at the place with the camera's field of view, or look from outside again."""
        through = bool(self.controls.through.value)
        camera = self.client.camera
        if self.place is None or self.axis is None:
            self.controls.through.value = False
            return
        self._follows = time.monotonic()
        with self.client.atomic():
            if through:
                self._outside = camera.position, camera.look_at, camera.fov
                camera.fov = self.fov
                camera.position = self.place.position
                camera.look_at = self.place.position + 0.05 * self.axis
            elif self._outside is not None:
                camera.fov = self._outside[2]
                camera.position, camera.look_at = self._outside[:2]
        for name in IN_THE_WAY:
            if (handle := self.scene.get_handle_by_name(name)) is not None:
                handle.visible = not through
        self.submit("scene", SOON, _once(self.draw_scene))

    @property
    def fov(self) -> float:
        """The camera's field of view from top to bottom, radians; of one with distortion, about."""
        camera = self.opened.camera
        return 2 * float(np.arctan(camera.height / 2 / camera.mean_focal_px))

    def _thin(self, less: int) -> None:
        if not self.closed:
            with self.client.atomic():
                self.scenery.thin(less)

    def _camera_moved(self) -> None:
        camera = self.client.camera
        (ex, ey, ez), (tx, ty, tz) = (map(float, point) for point in (camera.position, camera.look_at))
        eye = (ex, ey, ez)
        target = (tx, ty, tz)
        if np.isfinite((eye, target)).all():
            self._turning_camera.moved(eye, target)
            self.note(eye=eye, target=target)
            self.submit("state", LATER, _once(self.tell_state))
        if self.controls.through.value and time.monotonic() - self._follows > 0.3:
            self.turn_to(rotation_from_quaternion(camera.wxyz)[:, 2])

    # -- the scene -----------------------------------------------------------------------------------------------------

    def draw_scene(self) -> None:
        """Mesh, landmarks and mapping cameras, cut open."""
        inside = bool(self.controls.through.value)
        self.scenery.draw(self.state, inside)
        if not inside:
            self.judge()

    def fill_floor(self) -> None:
        """Colour the floor, as its scores come in."""
        self.submit("floor", LATER, self.scenery.fill(self.state))
        self.tell_state()

    def judge(self) -> None:
        """Show the labels, and where the prediction was wrong."""
        self.submit("labels", SOON, self.scenery.judge(self.state))

    # -- a place -------------------------------------------------------------------------------------------------------

    def go_to(self, position: Float, angles: tuple[float, float] | None = None) -> None:
        """Look around at a place; then at its best view, or as the angles (yaw, pitch) in degrees say."""
        self.submit("place", SOON, self._around(np.asarray(position, dtype=np.float64), angles))

    def _around(self, position: Float, angles: tuple[float, float] | None) -> Iterator[None]:
        if self.place is None:
            self.controls.told.content = "Scoring all directions ..."
        look = self.shared.look(self.state.method, self.state.occlusion)
        yield
        try:
            place = look_around(look, position, self.state.n)
        except TableError as error:
            problem = "no camera can be there: it is outside the map or inside geometry"
            raise ConfigError(problem, value=tuple(np.round(position, 2).tolist())) from error
        self.place = place
        self.note(place=(float(position[0]), float(position[1]), float(position[2])))
        low, high = self.scenery.range if self.shared.is_probability(self.state.method) else (0.0, 0.0)
        if low == high:
            low = float(place.scores.min())
            high = float(place.scores.max())
        mark = self.shared.mark_m
        glb = drawing.sphere_glb(place.directions, place.scores, low, high, mark)
        self.scene.add_glb("/sphere", glb, position=position, cast_shadow=False, receive_shadow=False)
        edges = drawing.frusta(self.opened.camera, place.best.cam_from_world, 2.2 * mark)
        colors = np.repeat(drawing.linear_light(drawing.score_colors(place.best.score, low, high)), 8, axis=0)
        self.scene.add_line_segments(
            "/views", edges, np.repeat(colors[:, None], 2, axis=1), thickness=2.0, thickness_units="screen"
        )
        self._turning(position)
        self.controls.told.content = _told(place, self.state)
        self.turn_to(place.best.axes[0] if angles is None else axes_of_angles(angles))
        self.controls.view.max = max(2, len(place.best))

    def _turning(self, position: Float) -> None:
        """Rings that turn the camera by hand."""
        self._gizmo = self.scene.add_transform_controls(
            "/turn",
            3.0 * self.shared.mark_m,
            disable_axes=True,
            disable_sliders=True,
            position=position,
            depth_test=False,
            line_width=1.5,
        )
        self._gizmo.on_update(self.newest(lambda _: self._dragged()))

    def _dragged(self) -> None:
        self.turn_to(rotation_from_quaternion(self._gizmo.wxyz)[:, 2], rings=True)

    def show_best(self, number: int) -> None:
        """Look along one of the best views."""
        if self.place is not None and 0 <= number < len(self.place.best):
            self.turn_to(self.place.best.axes[number])

    def turn_to(self, axis: Float, rings: bool = False, sliders: bool = False) -> None:
        """Look along an axis (3,) at the place; its score follows at once.

        `rings` or `sliders` say what it was turned by, which is then left as it is.
        """
        if self.place is None or not np.isfinite(axis).all() or np.linalg.norm(axis) < 1e-9:
            return
        self.axis = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
        self.submit("view", NOW, self._view(self.place.position, self.axis, rings, sliders))

    def _view(self, position: Float, axis: Float, rings: bool, sliders: bool) -> Iterator[None]:
        c = self.controls
        mark = self.shared.mark_m
        look = self.shared.look(self.state.method, self.state.occlusion)
        report = report_of(look.scorer, position, axis)
        score = float(report.score[0])
        told = f"**score {score:.3g}** · {report.n_visible[0]:,} landmarks in view"
        if np.isfinite(report.expected_inliers[0]):
            told += f" · {report.expected_inliers[0]:,.0f} expected to be found"
        if not report.in_range[0]:
            told += " · unlike what was learnt from"
        c.picture_told.content = told
        pose = poses_looking_along(position, axis)
        wxyz = quaternion_from_rotation(pose[:, :3].T)
        camera = self.opened.camera
        visible = not c.through.value
        self.scene.add_camera_frustum(
            "/view",
            self.fov,
            camera.width / camera.height,
            scale=3.0 * mark,
            color=drawing.PROMISED,
            wxyz=wxyz,
            position=position,
            thickness=4,
            thickness_units="screen",
            visible=visible,
            cast_shadow=False,
            receive_shadow=False,
        )
        self.client.flush()
        if not rings and self._gizmo is not None:
            self._gizmo.wxyz = wxyz
        yaw, pitch = (float(np.degrees(angle)) for angle in pan_tilt_angles(axis))
        if not sliders:
            c.yaw.value = round(yaw * 2) / 2
            c.pitch.value = round(pitch * 2) / 2
        self.note(yaw=round(yaw, 1), pitch=round(pitch, 1))
        yield
        seen = landmarks_seen(look.scorer, pose, self.shared.teller(self.state.occlusion))
        if len(seen.points):
            center = seen.points.mean(0)
            self.scene.add_point_cloud(
                "/seen",
                (seen.points - center).astype(np.float32),
                drawing.score_colors(seen.chances),
                point_size=0.0032 * self.shared.size_m,
                point_shape="circle",
                precision="float32",
                position=center,
                point_shading="flat",
                visible=visible,
            )
        else:
            self.scene.remove_by_name("/seen")
        yield
        image, what = self.opened.picture(pose, seen)
        c.picture.image = image
        c.picture.visible = True
        c.picture.label = what
        self.tell_state()

    def tell_state(self) -> None:
        """Show the state as a text and a link."""
        text = self.state.text()
        if self.controls.state.value != text:
            self.controls.state.value = text
            self.controls.link.content = f"[A link to this view]({self.state.link(self.host)})"

    def close(self) -> None:
        """The client has gone."""
        self.closed = True
        self._inbox.stop(wait=False)
        self.shared.worker.forget(self.client.client_id)


def _told(place: Place, state: ViewState) -> str:
    x, y, z = place.position
    share = np.mean(place.scores >= state.threshold)
    median = _brief(float(np.median(place.scores)))
    told = f"At {x:.2f}, {y:.2f}, {z:.2f} m: best {place.best.score[0]:.3g}, median {median}"
    return f"{told}; {100 * share:.0f} % of directions are good." if place.scores.max() <= 1 else f"{told}."


def _brief(score: float) -> str:
    """A score in few letters: of a probability two decimals, since 5.26e-05 tells nobody anything."""
    return f"{score:.2f}" if 0 <= score <= 1 else f"{score:.3g}"


def _once(then: Callable[[], None]) -> Iterator[None]:
    then()
    yield
