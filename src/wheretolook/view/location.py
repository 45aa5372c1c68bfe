"""The selected location of one client: score of every direction, best views, and the view turned by hand."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from wheretolook.geometry.camera_turns import pan_tilt_angles
from wheretolook.geometry.lattices import axes_of_angles
from wheretolook.geometry.poses import Float, poses_looking_along, quaternion_from_rotation, rotation_from_quaternion
from wheretolook.mapping.map_frame import MapFrame
from wheretolook.utils.errors import ConfigError, TableError
from wheretolook.utils.texts import counted
from wheretolook.view import drawing
from wheretolook.view.controls import value_of
from wheretolook.view.scores import ScoredLocation, score_location
from wheretolook.view.session import Session
from wheretolook.view.worker import NOW, SOON

if TYPE_CHECKING:  # torch and Warp are imported when scores are first computed
    from wheretolook.inputs.landmark_features import ReasonCounts

MARKERS = ("/sphere", "/view", "/views", "/turn", "/seen")  # hidden while the browser's camera is inside
SETTLE_S = 0.3  # camera motion this soon after the program moved the camera is not by hand


class LocationView:
    """Draws and reports the selected location and view of a session."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.axis: Float | None = None
        self._rings: Any = None
        self._outside: Any = None  # camera pose before it moved inside
        self._camera_set = 0.0  # when the program last moved the browser's camera
        c = session.controls
        session.on(c.view, self._show_best)
        for slider in (c.yaw, c.pitch):
            session.on(slider, self._sliders_moved, by_hand=True)
        session.on(c.inside, self._move_inside)
        session.on(c.leave, lambda: setattr(c.inside, "value", False))

    def select(self, position: Float, angles: tuple[float, float] | None = None) -> None:
        """Score a location (3,) m, and show its best view or the one with angles (yaw, pitch) in degrees."""
        self.session.submit("place", SOON, self._select(position, angles))

    def refresh(self) -> None:
        """Score the location again, such as by another method."""
        if self.session.location is not None:
            state = self.session.state
            angles = None if state.yaw is None or state.pitch is None else (state.yaw, state.pitch)
            self.select(self.session.location.position, angles)

    def _select(self, position: Float, angles: tuple[float, float] | None) -> Iterator[None]:
        session = self.session
        if session.location is None:
            session.controls.summary.content = "Scoring all directions ..."
        selector = session.selector
        yield
        try:
            location = score_location(selector, position, session.state.n)
        except TableError as error:
            problem = "no camera can be there: it is outside the map or inside geometry"
            raise ConfigError(problem, value=tuple(np.round(position, 2).tolist())) from error
        session.location = location
        session.update(place=tuple(position.tolist()))
        self._draw_location(location)
        session.controls.summary.content = describe(location, session.state.threshold, session.viewed.frame)
        self.turn_to(location.best.axes[0] if angles is None else axes_of_angles(angles))
        session.controls.view.max = max(2, len(location.best))

    def _draw_location(self, location: ScoredLocation) -> None:
        session = self.session
        viewed = session.viewed
        low, high = viewed.score_range(session.state.method, location.scores)
        sphere = drawing.sphere_glb(location.directions, location.scores, low, high, viewed.marker_m)
        position = location.position
        session.scene.add_glb("/sphere", sphere, position=position, cast_shadow=False, receive_shadow=False)
        edges = drawing.frusta(viewed.camera, location.best.cam_from_world, 2.2 * viewed.marker_m)
        colors = np.repeat(drawing.score_colors(location.best.score, low, high), 8, axis=0)
        session.add_lines("/views", edges, drawing.line_ends(colors), 2.0)
        self._rings = session.scene.add_transform_controls(
            "/turn",
            3.0 * viewed.marker_m,
            disable_axes=True,
            disable_sliders=True,
            position=position,
            depth_test=False,
            line_width=1.5,
        )
        self._rings.on_update(session.callback(lambda _: self._rings_dragged()))

    def _show_best(self) -> None:
        location = self.session.location
        number = int(self.session.controls.view.value) - 1
        if location is not None and number < len(location.best):
            self.turn_to(location.best.axes[number])

    def _rings_dragged(self) -> None:
        self.turn_to(rotation_from_quaternion(self._rings.wxyz)[:, 2], by="rings")

    def _sliders_moved(self) -> None:
        controls = self.session.controls
        self.turn_to(axes_of_angles((value_of(controls.yaw), value_of(controls.pitch))), by="sliders")

    def turn_to(self, axis: Float, by: str = "") -> None:
        """Show the view along an axis (3,) at the location; the "rings" or "sliders" that turned it are not moved."""
        location = self.session.location
        if location is None or not np.isfinite(axis).all() or np.linalg.norm(axis) < 1e-9:
            return
        self.axis = axis / np.linalg.norm(axis)
        self.session.submit("view", NOW, self._show_view(location.position, self.axis, by))

    def _show_view(self, position: Float, axis: Float, by: str) -> Iterator[None]:
        """Report and draw a view: first its score, then its landmarks, then its image."""
        session = self.session
        c = session.controls
        state = session.state
        pose = poses_looking_along(position, axis)
        report = session.selector.scorer.report(pose[None])
        caption = f"**score {float(report.score[0]):.3g}** · {counted(report.n_visible[0], 'landmark')} in view"
        if np.isfinite(report.expected_inliers[0]):
            caption += f" · {counted(report.expected_inliers[0], 'expected inlier')}"
        if not report.in_range[0]:
            caption += " · outside the training distribution"
        c.picture_caption.content = caption
        outside = not c.inside.value
        session.add_frustum("/view", pose, 3.0, drawing.FALSE_POSITIVE, thickness=4, visible=outside)
        session.client.flush()
        if by != "rings" and self._rings is not None:
            self._rings.wxyz = quaternion_from_rotation(pose[:, :3].T)
        yaw, pitch = (float(np.degrees(angle)) for angle in pan_tilt_angles(axis))
        if by != "sliders":
            c.yaw.value = round(yaw * 2) / 2
            c.pitch.value = round(pitch * 2) / 2
        session.update(yaw=round(yaw, 1), pitch=round(pitch, 1))
        yield
        landmarks = session.viewed.visible_landmarks(state.method, state.occlusion, pose)
        colors = drawing.score_colors(landmarks.probabilities)
        session.add_points("/seen", landmarks.points, colors, 0.0032 * session.viewed.size_m, outside)
        reasons = session.selector.reasons.count(pose[None])
        c.picture_caption.content = f"{caption}\n\n{describe_reasons(reasons)}"
        yield
        c.picture.image, c.picture.label = session.viewed.picture(pose, landmarks)
        c.picture.visible = c.picture_legend.visible = True
        session.show_state()

    def _move_inside(self) -> None:
        """Move the browser's camera to the view, with its field of view, or back outside."""
        session = self.session
        camera = session.client.camera
        inside = bool(session.controls.inside.value)
        if session.location is None or self.axis is None:
            session.controls.inside.value = False
            return
        session.controls.leave.visible = inside
        self._camera_set = time.monotonic()
        with session.client.atomic():
            if inside:
                self._outside = camera.position, camera.look_at, camera.fov
                camera.fov = session.fov
                camera.position = session.location.position
                camera.look_at = session.location.position + 0.05 * self.axis
            elif self._outside is not None:
                position, look_at, camera.fov = self._outside
                camera.position = position
                camera.look_at = look_at
        for name in MARKERS:
            if (handle := session.scene.get_handle_by_name(name)) is not None:
                handle.visible = not inside

    def camera_moved(self) -> None:
        """Turn the view with the browser's camera while that is inside."""
        if self.session.controls.inside.value and time.monotonic() - self._camera_set > SETTLE_S:
            self.turn_to(rotation_from_quaternion(self.session.client.camera.wxyz)[:, 2])


def describe_reasons(counts: ReasonCounts) -> str:
    """State how many landmarks are hard to match in a view, by reason."""
    names = {"too far": counts.n_too_far, "too oblique": counts.n_too_oblique, "repeated": counts.n_repeated}
    of_visible = ", ".join(f"{n[0]:,.0f} {name}" for name, n in names.items() if np.isfinite(n[0]))
    return f"of these {of_visible}; {counts.n_occluded[0]:,} more occluded"


def describe(location: ScoredLocation, threshold: float, frame: MapFrame) -> str:
    """Summarize the scores of a location, whose coordinates are shown in the map's own frame."""
    x, y, z = frame.world_from_map.inverse.apply(location.position)
    median = float(np.median(location.scores))
    median_text = f"{median:.2f}" if 0 <= median <= 1 else f"{median:.3g}"
    summary = f"At {x:.2f}, {y:.2f}, {z:.2f}: best {location.best.score[0]:.3g}, median {median_text}"
    if location.scores.max() > 1:
        return f"{summary}."
    return f"{summary}; {100 * np.mean(location.scores >= threshold):.0f} % of directions reach {threshold:.2f}."
