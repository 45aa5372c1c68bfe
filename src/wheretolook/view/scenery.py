"""Draw the scene for one client: mesh, landmarks, mapping cameras, paths, coloured floor, labels."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from wheretolook.geometry.poses import camera_centers
from wheretolook.utils.texts import counted
from wheretolook.view import drawing
from wheretolook.view.controls import LIMITS
from wheretolook.view.scores import FIRST_CELLS, Floor, score_in_blocks
from wheretolook.view.session import Session
from wheretolook.view.state import ViewState

REDRAW_S = 0.4  # between two images of a growing floor
CELLS_PER_STEP = 2  # one per core
MESH_LOADING_S = 1.5  # until a browser has loaded a mesh
MAX_LANDMARKS = 400_000
PATH_COLORS = ((120, 120, 120), (213, 94, 0), (0, 114, 178), (0, 158, 115), (204, 121, 167))


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
        stride = max(1, -(-len(points) // MAX_LANDMARKS))
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
            timer = threading.Timer(MESH_LOADING_S if mesh is not None else 0.0, self._remove_mesh, (old,))
            timer.daemon = True
            timer.start()

    def _remove_mesh(self, name: str) -> None:
        if name != self._mesh_name:
            self.scene.remove_by_name(name)

    def draw_paths(self) -> None:
        """Draw the positions and cameras of each path, and its name at the end."""
        marker_m = self.viewed.marker_m
        for number, (name, path) in enumerate(self.viewed.paths.items()):
            positions = camera_centers(path.cam_from_world)
            steps = np.stack([positions[:-1], positions[1:]], axis=1)
            edges = drawing.frusta(self.viewed.camera, path.cam_from_world, marker_m)
            color = PATH_COLORS[number % len(PATH_COLORS)]
            self.session.add_lines(f"/paths/{name}", np.concatenate([steps, edges]), color, 2.0)
            # above each other, since paths may share their positions
            label_position = positions[-1] + (0.0, 0.0, (1 + number) * marker_m)
            self.scene.add_label(f"/paths/{name}/name", name, position=label_position, font_screen_scale=0.8)

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
        while floor.score_next(CELLS_PER_STEP):
            if floor.n_scored >= FIRST_CELLS and time.monotonic() - drawn > REDRAW_S:
                self._color_floor(floor, state)
                drawn = time.monotonic()
            yield
        self._color_floor(floor, state)

    def _color_floor(self, floor: Floor, state: ViewState) -> None:
        """Draw a floor and its colour scale, and report how much of it is good."""
        score_range = self.viewed.score_range(state.method, floor.scores)
        self.controls.legend.content = drawing.legend(*score_range)
        status = f"**{state.method}**: {floor.n_scored:,} of {len(floor.cells):,} locations"
        threshold = None
        if self.viewed.is_probability(state.method):
            threshold = state.threshold
            status += (
                f", at least {threshold:.2f} at {100 * np.mean(floor.scores[: floor.n_scored] >= threshold):.0f} %"
            )
        self.controls.status.content = status
        image = drawing.floor_image(floor.raster(), *score_range, threshold)
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
