"""The selected location of one client: score of every direction, best views, and the view turned by hand."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from wheretolook.geometry.camera_turns import pan_tilt_angles
from wheretolook.geometry.lattices import axes_of_angles
from wheretolook.geometry.poses import Float, poses_looking_along, quaternion_from_rotation, rotation_from_quaternion
from wheretolook.utils.errors import ConfigError, TableError
from wheretolook.view import drawing
from wheretolook.view.controls import value_of
from wheretolook.view.scenery import add_points
from wheretolook.view.scores import ScoredLocation, score_location, visible_landmarks
from wheretolook.view.state import ViewState
from wheretolook.view.worker import NOW, SOON

if TYPE_CHECKING:
    from wheretolook.view.session import Session

MARKERS = ("/sphere", "/view", "/views", "/turn", "/seen")  # hidden while the browser's camera is inside
SETTLE_S = 0.3  # camera motion this soon after the program moved the camera is not by hand


class LocationView:
    """Draws and reports the selected location and view of a session."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.location: ScoredLocation | None = None
        self.axis: Float | None = None
        self._rings: Any = None
        self._outside: Any = None  # camera pose before it moved inside
        self._camera_set = 0.0  # when the program last moved the browser's camera
        c = session.controls
        session.on(c.view, lambda: self.show_best(int(c.view.value) - 1))
        for slider in (c.yaw, c.pitch):
            session.on(slider, self._sliders_moved, by_hand=True)
        session.on(c.inside, self._move_inside)

    @property
    def angles(self) -> tuple[float, float]:
        """Yaw and pitch of the view in degrees, as the sliders show them."""
        c = self.session.controls
        return float(value_of(c.yaw, 0.0)), float(value_of(c.pitch, 0.0))

    @property
    def fov(self) -> float:
        """The vertical field of view in radians, without distortion."""
        camera = self.session.viewed.camera
        return 2 * float(np.arctan(camera.height / 2 / camera.mean_focal_px))

    def select(self, position: Float, angles: tuple[float, float] | None = None) -> None:
        """Score a location (3,) m, and show its best view or the one with angles (yaw, pitch) in degrees."""
        self.session.submit("place", SOON, self._select(np.asarray(position, dtype=np.float64), angles))

    def refresh(self) -> None:
        """Score the location again, such as by another method."""
        if self.location is not None:
            self.select(self.location.position, None if self.axis is None else self.angles)

    def _select(self, position: Float, angles: tuple[float, float] | None) -> Iterator[None]:
        session = self.session
        if self.location is None:
            session.controls.summary.content = "Scoring all directions ..."
        selector = session.selector
        yield
        try:
            location = score_location(selector, position, session.state.n)
        except TableError as error:
            problem = "no camera can be there: it is outside the map or inside geometry"
            raise ConfigError(problem, value=tuple(np.round(position, 2).tolist())) from error
        self.location = location
        session.update(place=tuple(position.tolist()))
        self._draw_location(location)
        session.controls.summary.content = describe(location, session.state)
        self.turn_to(location.best.axes[0] if angles is None else axes_of_angles(angles))
        session.controls.view.max = max(2, len(location.best))

    def _draw_location(self, location: ScoredLocation) -> None:
        session = self.session
        scene = session.scene
        low, high = session.scenery.score_range
        if low == high or not session.shared.is_probability(session.state.method):
            low = float(location.scores.min())
            high = float(location.scores.max())
        size_m = session.shared.marker_m
        position = location.position
        sphere = drawing.sphere_glb(location.directions, location.scores, low, high, size_m)
        scene.add_glb("/sphere", sphere, position=position, cast_shadow=False, receive_shadow=False)
        edges = drawing.frusta(session.viewed.camera, location.best.cam_from_world, 2.2 * size_m)
        colors = np.repeat(drawing.linear_light(drawing.score_colors(location.best.score, low, high)), 8, axis=0)
        ends = np.repeat(colors[:, None], 2, axis=1)
        scene.add_line_segments("/views", edges, ends, thickness=2.0, thickness_units="screen")
        self._rings = scene.add_transform_controls(
            "/turn",
            3.0 * size_m,
            disable_axes=True,
            disable_sliders=True,
            position=position,
            depth_test=False,
            line_width=1.5,
        )
        self._rings.on_update(session.callback(lambda _: self._rings_dragged()))

    def show_best(self, number: int) -> None:
        """Show one of the best views."""
        if self.location is not None and 0 <= number < len(self.location.best):
            self.turn_to(self.location.best.axes[number])

    def _rings_dragged(self) -> None:
        self.turn_to(rotation_from_quaternion(self._rings.wxyz)[:, 2], move_rings=False)

    def _sliders_moved(self) -> None:
        self.turn_to(axes_of_angles(self.angles), move_sliders=False)

    def turn_to(self, axis: Float, move_rings: bool = True, move_sliders: bool = True) -> None:
        """Show the view along an axis (3,) at the location; the control that turned it is not moved."""
        if self.location is None or not np.isfinite(axis).all() or np.linalg.norm(axis) < 1e-9:
            return
        self.axis = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
        self.session.submit("view", NOW, self._show_view(self.location.position, self.axis, move_rings, move_sliders))

    def _show_view(self, position: Float, axis: Float, move_rings: bool, move_sliders: bool) -> Iterator[None]:
        session = self.session
        c = session.controls
        scorer = session.selector.scorer
        pose = poses_looking_along(position, axis)
        report = scorer.report(pose[None])
        caption = f"**score {float(report.score[0]):.3g}** · {report.n_visible[0]:,} landmarks in view"
        if np.isfinite(report.expected_inliers[0]):
            caption += f" · {report.expected_inliers[0]:,.0f} expected inliers"
        if not report.in_range[0]:
            caption += " · outside the training distribution"
        c.picture_caption.content = caption
        wxyz = quaternion_from_rotation(pose[:, :3].T)
        marker_visible = not c.inside.value
        session.add_frustum("/view", wxyz, position, 3.0, drawing.FALSE_POSITIVE, thickness=4, visible=marker_visible)
        session.client.flush()
        if move_rings and self._rings is not None:
            self._rings.wxyz = wxyz
        yaw, pitch = (float(np.degrees(angle)) for angle in pan_tilt_angles(axis))
        if move_sliders:
            c.yaw.value = round(yaw * 2) / 2
            c.pitch.value = round(pitch * 2) / 2
        session.update(yaw=round(yaw, 1), pitch=round(pitch, 1))
        yield
        landmarks = visible_landmarks(scorer, pose, session.shared.landmark_scorer(session.state.occlusion))
        if len(landmarks.points):
            colors = drawing.score_colors(landmarks.probabilities)
            size_m = 0.0032 * session.shared.size_m
            add_points(session.scene, "/seen", landmarks.points, colors, size_m, marker_visible)
        else:
            session.scene.remove_by_name("/seen")
        yield
        c.picture.image, c.picture.label = session.viewed.picture(pose, landmarks)
        c.picture.visible = True
        session.show_state()

    def _move_inside(self) -> None:
        """Move the browser's camera to the view, with its field of view, or back outside."""
        session = self.session
        camera = session.client.camera
        inside = bool(session.controls.inside.value)
        if self.location is None or self.axis is None:
            session.controls.inside.value = False
            return
        self._camera_set = time.monotonic()
        with session.client.atomic():
            if inside:
                self._outside = camera.position, camera.look_at, camera.fov
                camera.fov = self.fov
                camera.position = self.location.position
                camera.look_at = self.location.position + 0.05 * self.axis
            elif self._outside is not None:
                position, look_at, camera.fov = self._outside
                camera.position = position
                camera.look_at = look_at
        for name in MARKERS:
            if (handle := session.scene.get_handle_by_name(name)) is not None:
                handle.visible = not inside
        session.redraw()

    def camera_moved(self) -> None:
        """Turn the view with the browser's camera while that is inside."""
        if self.session.controls.inside.value and time.monotonic() - self._camera_set > SETTLE_S:
            self.turn_to(rotation_from_quaternion(self.session.client.camera.wxyz)[:, 2])


def describe(location: ScoredLocation, state: ViewState) -> str:
    """Summarize the scores of a location."""
    x, y, z = location.position
    median = float(np.median(location.scores))
    median_text = f"{median:.2f}" if 0 <= median <= 1 else f"{median:.3g}"
    summary = f"At {x:.2f}, {y:.2f}, {z:.2f} m: best {location.best.score[0]:.3g}, median {median_text}"
    if location.scores.max() > 1:
        return f"{summary}."
    return f"{summary}; {100 * np.mean(location.scores >= state.threshold):.0f} % of directions are good."
