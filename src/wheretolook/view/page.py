"""The page of one client: scene, selected location and paths, and what connects them."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from wheretolook.geometry.lattices import axes_of_angles
from wheretolook.geometry.poses import (
    Float,
    camera_centers,
    pan_tilt_angles,
    poses_looking_along,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from wheretolook.mapping.map_frame import MapFrame
from wheretolook.utils.errors import ConfigError, TableError
from wheretolook.utils.texts import counted
from wheretolook.view import drawing
from wheretolook.view.session import LATER, LIMITS, NOW, SOON, Session, Worker, once, value_of
from wheretolook.view.state import ViewState
from wheretolook.view.viewed_map import FIRST_CELLS, Floor, ScoredLocation, ViewedMap, score_in_blocks, score_location

if TYPE_CHECKING:
    from viser import ClientHandle

    from wheretolook.geometry.views import Views


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
        # hidden while the browser's camera is inside
        for name in ("/sphere", "/view", "/views", "/turn", "/seen"):
            if (handle := session.scene.get_handle_by_name(name)) is not None:
                handle.visible = not inside

    def camera_moved(self) -> None:
        """Turn the view with the browser's camera while that is inside."""
        # motion within 0.3 s after the program moved the camera is not by hand
        if self.session.controls.inside.value and time.monotonic() - self._camera_set > 0.3:
            self.turn_to(rotation_from_quaternion(self.session.client.camera.wxyz)[:, 2])


def describe_reasons(counts: Views) -> str:
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


class Scenery:
    """Draws the scene for one client."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.scene = session.scene
        self.viewed = session.viewed
        self.controls = session.controls
        self.floor_m = session.viewed.usual_m  # height at which the floor is drawn and clicked
        self._floor: Floor | None = None
        self._mesh: bytes | None = None
        self._mesh_name = ""

    def draw(self) -> None:
        """Draw the enabled layers below the cut; from inside the scene the whole mesh only."""
        layers = {name: bool(layer.value) for name, layer in self.controls.layers.items()}
        inside = bool(self.controls.inside.value)
        cut = None if inside else self.session.state.cut
        self._draw_mesh(self.viewed.mesh_glb(cut) if layers["mesh"] else None)
        points = self.viewed.landmarks.points
        if cut is not None:
            points = points[points[:, 2] <= cut]
        stride = max(1, -(-len(points) // 400_000))
        points = points[::stride] if layers["landmarks"] else points[:0]
        self.session.add_points("/landmarks", points, drawing.LANDMARK_COLOR, 0.0018 * self.viewed.size_m)
        poses = self.viewed.mapping_poses
        if layers["cameras"] and poses is not None and not inside:
            edges = drawing.frusta(self.viewed.camera, poses, self.viewed.marker_m)
            self.session.add_lines("/cameras", edges, drawing.CAMERA_COLOR, 1.2)
        else:
            self.scene.remove_by_name("/cameras")
        for name in ("floor", "labels"):
            if (handle := self.scene.get_handle_by_name(f"/{name}")) is not None:
                handle.visible = layers[name] and not inside

    def _draw_mesh(self, mesh: bytes | None) -> None:
        """Replace the mesh; the old one stays until the browser has loaded the new one."""
        if mesh is self._mesh:
            return
        old = self._mesh_name
        self._mesh = mesh
        self._mesh_name = ""
        if mesh is not None:
            self._mesh_name = "/mesh/a" if old != "/mesh/a" else "/mesh/b"
            self.scene.add_glb(self._mesh_name, mesh, cast_shadow=False, receive_shadow=False)
        if old:
            # the time until a browser has loaded a mesh
            timer = threading.Timer(1.5 if mesh is not None else 0.0, self._remove_mesh, (old,))
            timer.daemon = True
            timer.start()

    def _remove_mesh(self, name: str) -> None:
        if name != self._mesh_name:
            self.scene.remove_by_name(name)

    def draw_paths(self) -> None:
        """Draw the positions and cameras of each path."""
        for number, (name, path) in enumerate(self.viewed.paths.items()):
            positions = camera_centers(path.cam_from_world)
            steps = np.stack([positions[:-1], positions[1:]], axis=1)
            edges = drawing.frusta(self.viewed.camera, path.cam_from_world, self.viewed.marker_m)
            lines = np.concatenate([steps, edges])
            self.session.add_lines(f"/paths/{name}", lines, drawing.path_color(number), 2.0)

    def fill_floor(self, state: ViewState) -> Iterator[None]:
        """Score and colour the floor, some cells per step."""
        assert state.height is not None
        self.controls.status.content = f"Scoring by **{state.method}** ..."
        self.controls.weights.content = self.viewed.weights.describe(state.method)
        floor = self.viewed.floor(state.method, state.occlusion, state.height)
        if len(floor.cells) == 0:
            self.scene.remove_by_name("/floor")
            self._floor = None
            self.controls.status.content = f"No camera can be at {state.height:.2f} m. Try another height."
            return
        yield
        drawn = 0.0
        while floor.score_next(2):
            if floor.n_scored >= FIRST_CELLS and time.monotonic() - drawn > 0.4:
                self._color_floor(floor, state)
                drawn = time.monotonic()
            yield
        self._color_floor(floor, state)

    def _color_floor(self, floor: Floor, state: ViewState) -> None:
        """Draw a floor and its colour scale, and report how much of it is good."""
        low, high = self.viewed.score_range(state.method, floor.scores)
        self.controls.legend.content = drawing.legend(low, high)
        status = f"**{state.method}**: {floor.n_scored:,} of {len(floor.cells):,} locations"
        threshold = None
        if self.viewed.is_probability(state.method):
            threshold = state.threshold
            status += (
                f", at least {threshold:.2f} at {100 * np.mean(floor.scores[: floor.n_scored] >= threshold):.0f} %"
            )
        self.controls.status.content = status
        image = drawing.floor_image(floor.raster(), low, high, threshold)
        handle: Any = self.scene.get_handle_by_name("/floor")
        if self._floor is floor and handle is not None:
            handle.image = image
            return
        self._floor = floor
        self.floor_m = floor.drawn_m
        size_m = np.array(floor.shape[::-1]) * floor.cell_m
        self.scene.add_image(
            "/floor",
            image,
            *size_m.tolist(),
            format="png",
            cast_shadow=False,
            receive_shadow=False,
            position=(*(floor.lower + size_m / 2), floor.drawn_m),
            visible=bool(self.controls.layers["floor"].value),
        )

    def draw_labels(self, state: ViewState) -> Iterator[None]:
        """Draw the labelled views in colours of prediction errors."""
        table = self.viewed.labels
        if table is None or not self.controls.layers["labels"].value:
            self.scene.remove_by_name("/labels")
            self.controls.label_summary.content = ""
            return

        from wheretolook.dataset.viewpoint_table import is_good, poses

        cam_from_world = poses(table)
        good = is_good(table, *LIMITS[self.controls.limits.value])
        selector = self.viewed.selector(state.method, state.occlusion)
        scores = yield from score_in_blocks(selector.scorer, cam_from_world)
        predicted = scores >= state.threshold if self.viewed.is_probability(state.method) else good
        colors = np.where(good[:, None], drawing.TRUE_POSITIVE, drawing.TRUE_NEGATIVE)
        colors[predicted & ~good] = drawing.FALSE_POSITIVE
        colors[good & ~predicted] = drawing.FALSE_NEGATIVE
        summary = f"{counted(len(good), 'labelled view')}, {100 * good.mean():.0f} % localize."
        if predicted is not good:
            summary += f" Wrong at {state.threshold:.2f}: {(predicted & ~good).sum()} predicted to localize but lost"
            summary += f" (orange), {(good & ~predicted).sum()} localized against the prediction (blue)."
        starts = camera_centers(cam_from_world)
        segments = np.stack([starts, starts + self.viewed.marker_m * cam_from_world[:, 2, :3]], axis=1)
        self.session.add_lines("/labels", segments, drawing.line_ends(colors), 2.0)
        self.controls.label_summary.content = summary


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
        grey = np.full((2, 2, 3), (72, 74, 80), np.uint8)  # low scores are invisible on black
        self.scene.set_background_image(grey if dark else None, format="png")
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
