"""Draw the scene for one client: mesh, landmarks, mapping cameras, coloured floor, labels."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from wheretolook.geometry.poses import Float
from wheretolook.view import drawing
from wheretolook.view.controls import LIMITS, Controls
from wheretolook.view.scores import Floor, score_labels
from wheretolook.view.shared import Shared
from wheretolook.view.state import ViewState

if TYPE_CHECKING:
    from viser import SceneApi

REDRAW_S = 0.4  # between two images of a growing floor
CELLS_PER_STEP = 2  # one per core
ABOVE_GROUND_M = 0.03  # above carpets
MESH_LOADING_S = 1.5  # until a browser has loaded a mesh
MAX_LANDMARKS = 400_000
FEWER_LANDMARKS = (20_000, 5_000, 1_500)  # for slow browsers whose camera moves, by level of detail
CAMERA_COLOR = (86, 180, 233)
LANDMARK_COLOR = (150, 150, 155)


def add_points(scene: SceneApi, name: str, points: Float, colors: Any, size_m: float, visible: bool = True) -> None:
    """Draw points (N, 3) m; coordinates are sent relative to their mean, since single precision is coarse far away."""
    center = points.mean(0)
    scene.add_point_cloud(
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


class Scenery:
    """Draws the scene for one client."""

    def __init__(self, scene: SceneApi, shared: Shared, controls: Controls) -> None:
        self.scene = scene
        self.shared = shared
        self.controls = controls
        self.score_range = (0.0, 1.0)  # at the ends of the colour scale
        self.floor_m = shared.usual_m  # height at which the floor is drawn and clicked
        self._floor: Floor | None = None
        self._mesh: bytes | None = None
        self._mesh_name = ""
        self._level = 0  # of detail of the landmarks
        self._landmark_lock = threading.Lock()

    def draw(self, state: ViewState, inside: bool = False) -> None:
        """Draw the enabled layers below the cut; from inside the scene the whole mesh only."""
        layers = self.controls.layers
        viewed = self.shared.viewed
        cut = None if inside else state.cut
        self._draw_mesh(self.shared.mesh(cut) if layers["mesh"].value else None)
        points = viewed.landmarks.points
        if not layers["landmarks"].value:
            points = points[:0]
        elif cut is not None:
            points = points[points[:, 2] <= cut]
        self._draw_landmarks(_thinned(points, MAX_LANDMARKS))
        if layers["cameras"].value and viewed.mapping_poses is not None and not inside:
            edges = drawing.frusta(viewed.camera, viewed.mapping_poses, self.shared.marker_m)
            self.scene.add_line_segments("/cameras", edges, CAMERA_COLOR, thickness=1.2, thickness_units="screen")
        else:
            self.scene.remove_by_name("/cameras")
        for name in ("floor", "labels"):
            if (handle := self.scene.get_handle_by_name(f"/{name}")) is not None:
                handle.visible = bool(layers[name].value) and not inside

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
            timer = threading.Timer(MESH_LOADING_S if mesh is not None else 0.0, self._remove_old_mesh, (old,))
            timer.daemon = True
            timer.start()

    def _remove_old_mesh(self, name: str) -> None:
        if name != self._mesh_name:
            self.scene.remove_by_name(name)

    def _draw_landmarks(self, points: Float) -> None:
        """Draw one point cloud per level of detail, of which one is visible."""
        with self._landmark_lock:
            clouds = [points]
            for limit in FEWER_LANDMARKS:
                clouds.append(_thinned(points, limit) if len(points) > limit else points[:0])
            drawn = [level for level, cloud in enumerate(clouds) if len(cloud)]
            for level, cloud in enumerate(clouds):
                if len(cloud):
                    visible = level == _visible_level(drawn, self._level)
                    size_m = 0.0018 * self.shared.size_m
                    add_points(self.scene, _cloud_name(level), cloud, LANDMARK_COLOR, size_m, visible=visible)
                else:
                    self.scene.remove_by_name(_cloud_name(level))

    def set_level(self, level: int) -> None:
        """Show all landmarks (0), or fewer (1 to the number of `FEWER_LANDMARKS`)."""
        with self._landmark_lock:
            self._level = level
            handles = {n: self.scene.get_handle_by_name(_cloud_name(n)) for n in range(len(FEWER_LANDMARKS) + 1)}
            drawn = [n for n, handle in handles.items() if handle is not None]
            for n in drawn:
                handle: Any = handles[n]
                if handle.visible != (n == _visible_level(drawn, level)):
                    handle.visible = not handle.visible

    def fill_floor(self, state: ViewState) -> Iterator[None]:
        """Score and colour the floor, some cells per step."""
        assert state.height is not None
        self.controls.status.content = f"Scoring by **{state.method}** ..."
        self.controls.weights.content = self.shared.viewed.weights.describe(state.method)
        floor, selector = self.shared.floor(state.method, state.occlusion, state.height)
        if len(floor.cells) == 0:
            self.scene.remove_by_name("/floor")
            self._floor = None
            self.controls.status.content = f"No camera can be at {state.height:.2f} m. Try another height."
            return
        yield
        drawn = 0.0
        while not floor.done:
            floor.score_next(selector, CELLS_PER_STEP)
            if floor.n_scored >= floor.n_first and time.monotonic() - drawn > REDRAW_S:
                self._color_floor(floor, state)
                drawn = time.monotonic()
            yield
        self._color_floor(floor, state)

    def _color_floor(self, floor: Floor, state: ViewState) -> None:
        raster = floor.raster()
        finite = raster[np.isfinite(raster)]
        is_probability = self.shared.is_probability(state.method)
        score_range = (0.0, 1.0) if is_probability else (float(finite.min()), float(finite.max()))
        if score_range != self.score_range:
            self.score_range = score_range
            self.controls.legend.content = drawing.legend(*score_range, "score")
        threshold = state.threshold if is_probability else None
        self._draw_floor(floor, drawing.floor_image(raster, *score_range, threshold))
        status = f"**{state.method}**: {floor.n_scored:,} of {len(floor.cells):,} places"
        if is_probability:
            status += f", good at {100 * np.mean(floor.scores[: floor.n_scored] >= state.threshold):.0f} %"
        self.controls.status.content = status

    def _draw_floor(self, floor: Floor, image: drawing.Rgb) -> None:
        """Draw a floor on the ground if its height is known, where it hides less than at the camera's height."""
        handle: Any = self.scene.get_handle_by_name("/floor")
        if self._floor is floor and handle is not None:
            handle.image = image
            return
        rows, columns = floor.shape
        self.floor_m = floor.height_m if floor.ground_m is None else floor.ground_m + ABOVE_GROUND_M
        size = np.array([columns, rows]) * floor.cell_m
        self.scene.add_image(
            "/floor",
            image,
            *size.tolist(),
            format="png",
            cast_shadow=False,
            receive_shadow=False,
            position=(*(floor.lower + size / 2), self.floor_m),
            visible=bool(self.controls.layers["floor"].value),
        )
        self._floor = floor

    def draw_labels(self, state: ViewState) -> Iterator[None]:
        """Draw the labelled views in colours of prediction errors."""
        table = self.shared.viewed.labels
        if table is None or not self.controls.layers["labels"].value:
            self.scene.remove_by_name("/labels")
            self.controls.label_summary.content = ""
            return
        scorer = self.shared.viewed.selector(state.method, state.occlusion).scorer
        labels = yield from score_labels(scorer, table, LIMITS[self.controls.limits.value], state.threshold)
        colors = np.where(labels.good[:, None], drawing.TRUE_POSITIVE, drawing.TRUE_NEGATIVE)
        summary = f"{len(labels.good):,} labelled views, {100 * labels.good.mean():.0f} % localize."
        if self.shared.is_probability(state.method):
            colors[labels.false_positive] = drawing.FALSE_POSITIVE
            colors[labels.false_negative] = drawing.FALSE_NEGATIVE
            summary += f" Wrong at {state.threshold:.2f}: {labels.false_positive.sum()} predicted to localize but lost"
            summary += f" (orange), {labels.false_negative.sum()} localized against the prediction (blue)."
        tips = labels.positions + self.shared.marker_m * labels.axes
        segments = np.stack([labels.positions, tips], axis=1)
        ends = np.repeat(drawing.linear_light(colors)[:, None], 2, axis=1)
        self.scene.add_line_segments("/labels", segments, ends, thickness=2.0, thickness_units="screen")
        self.controls.label_summary.content = summary


def _thinned(points: Float, limit: int) -> Float:
    """Select every k-th of points (N, 3), so that at most `limit` remain."""
    return points[:: max(1, -(-len(points) // limit))]


def _visible_level(drawn: list[int], level: int) -> int:
    """Return the highest drawn level of detail up to `level`."""
    return max((n for n in drawn if n <= level), default=0)


def _cloud_name(level: int) -> str:
    return f"/landmarks-{level}" if level else "/landmarks"
