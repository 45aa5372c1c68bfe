"""What surrounds a place, drawn for one client: mesh, landmarks, mapping cameras, the coloured floor, labels."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from wheretolook.geometry.poses import Float
from wheretolook.view import drawing
from wheretolook.view.controls import LIMITS, Controls
from wheretolook.view.scores import Floor, judged_labels
from wheretolook.view.shared import Shared
from wheretolook.view.state import ViewState

if TYPE_CHECKING:
    from viser import SceneApi

REDRAW_S = 0.4  # between two pictures of a floor that fills
AT_ONCE = 2  # places of a floor between two looks at what is more urgent: one for each core
ABOVE_GROUND_M = 0.03  # a floor is drawn over carpets
READ_S = 1.5  # until a browser has read a mesh
MOST_SHOWN = 400_000  # landmarks that are sent to a browser
FEWER = (20_000, 5_000, 1_500)  # of them, while a slow browser turns: the slower it is, the fewer


class Scenery:
    """Draws for one client. `range` are the scores at the ends of the colours; `drawn_m` is the height of the plane on
    which the floor is drawn, and on which clicks are meant.
    """

    def __init__(self, scene: SceneApi, shared: Shared, controls: Controls) -> None:
        self.scene = scene
        self.shared = shared
        self.controls = controls
        self.range = (0.0, 1.0)
        self.drawn_m = shared.usual_m
        self._floor: Floor | None = None
        self._mesh: bytes | None = None
        self._mesh_name = ""
        self._less = 0  # of landmarks; drawn and thinned in several threads
        self._drawing = threading.Lock()

    def draw(self, state: ViewState, inside: bool = False) -> None:
        """Draw mesh, landmarks and mapping cameras, as far as they are to be seen; the mesh whole and nothing else for
        one who stands inside."""
        shown = self.controls.shown
        cut = None if inside else state.cut
        opened = self.shared.opened
        self._draw_mesh(self.shared.mesh(cut) if shown["mesh"].value else None)
        points = opened.landmarks.points
        rows = np.arange(len(points)) if cut is None else np.flatnonzero(points[:, 2] <= cut)
        rows = rows[:: max(1, -(-len(rows) // MOST_SHOWN))]
        self._landmarks(points[rows] if shown["landmarks"].value else points[:0])
        if shown["cameras"].value and opened.mapping_poses is not None and not inside:
            edges = drawing.frusta(opened.camera, opened.mapping_poses, self.shared.mark_m)
            self.scene.add_line_segments("/cameras", edges, (86, 180, 233), thickness=1.2, thickness_units="screen")
        else:
            self.scene.remove_by_name("/cameras")
        for name in ("/floor", "/labels"):
            if (handle := self.scene.get_handle_by_name(name)) is not None:
                handle.visible = bool(shown[name[1:]].value) and not inside

    def _draw_mesh(self, mesh: bytes | None) -> None:
        """Put a mesh in place of the one that is drawn, which stays until the browser has read the new one."""
        if mesh is self._mesh:
            return
        old = self._mesh_name
        self._mesh = mesh
        if mesh is not None:
            self._mesh_name = "/mesh/a" if old != "/mesh/a" else "/mesh/b"
            self.scene.add_glb(self._mesh_name, mesh, cast_shadow=False, receive_shadow=False)
        else:
            self._mesh_name = ""
        if old:
            later = threading.Timer(READ_S if mesh is not None else 0.0, self._remove, (old,))
            later.daemon = True
            later.start()

    def _remove(self, name: str) -> None:
        if name != self._mesh_name:
            self.scene.remove_by_name(name)

    def _landmarks(self, points: Float) -> None:
        with self._drawing:
            parts = [points, *(points[:: max(1, -(-len(points) // most))] for most in FEWER)]
            drawn = [n for n, part in enumerate(parts) if len(part) > 0 and (n == 0 or len(part) < len(points))]
            for n, part in enumerate(parts):
                if n not in drawn:
                    self.scene.remove_by_name(_cloud(n))
                    continue
                center = part.mean(0)  # from the origin, single precision would be coarse in a map far from it
                self.scene.add_point_cloud(
                    _cloud(n),
                    (part - center).astype(np.float32),
                    (150, 150, 155),
                    point_size=0.0018 * self.shared.size_m,
                    point_shape="circle",
                    precision="float32",
                    position=center,
                    point_shading="flat",
                    visible=n == _shown(drawn, self._less),
                )

    def thin(self, less: int) -> None:
        """Show all landmarks (0), or some of them (1 to the number of `FEWER`), where they are more."""
        with self._drawing:
            self._less = less
            clouds = {n: self.scene.get_handle_by_name(_cloud(n)) for n in range(len(FEWER) + 1)}
            drawn = [n for n, cloud in clouds.items() if cloud is not None]
            for n in drawn:
                cloud: Any = clouds[n]
                if cloud.visible != (n == _shown(drawn, less)):
                    cloud.visible = not cloud.visible

    def fill(self, state: ViewState) -> Iterator[None]:
        """Colour the floor, some places at each step."""
        assert state.height is not None
        self.controls.status.content = f"Scoring by **{state.method}** ..."
        self.controls.weights.content = self.shared.opened.weights.told(state.method)
        floor, look = self.shared.floor(state.method, state.occlusion, state.height)
        if len(floor.cells) == 0:
            self.scene.remove_by_name("/floor")
            self._floor = None
            self.controls.status.content = f"No camera can be at {state.height:.2f} m. Try another height."
            return
        yield
        drawn = 0.0
        while not floor.done:
            floor.score_next(look, AT_ONCE)
            if floor.n_scored >= floor.n_first and time.monotonic() - drawn > REDRAW_S:
                self._color(floor, state)
                drawn = time.monotonic()
            yield
        self._color(floor, state)

    def _color(self, floor: Floor, state: ViewState) -> None:
        raster = floor.raster()
        probable = self.shared.is_probability(state.method)
        known = raster[np.isfinite(raster)]
        span = (0.0, 1.0) if probable else (float(known.min()), float(known.max()))
        if span != self.range:
            self.range = span
            self.controls.legend.content = drawing.legend(*span, "score")
        self._put(floor, drawing.floor_image(raster, *span, state.threshold if probable else None))
        told = f"**{state.method}**: {floor.n_scored:,} of {len(floor.cells):,} places"
        if probable:
            told += f", good at {100 * np.mean(floor.scores[: floor.n_scored] >= state.threshold):.0f} %"
        self.controls.status.content = told

    def _put(self, floor: Floor, image: drawing.Rgb) -> None:
        """Draw a floor on the ground, where it is known: at the camera's height it would hide the room."""
        handle: Any = self.scene.get_handle_by_name("/floor")
        if self._floor is floor and handle is not None:
            handle.image = image
            return
        rows, columns = floor.shape
        self.drawn_m = floor.height_m if floor.ground_m is None else floor.ground_m + ABOVE_GROUND_M
        self.scene.add_image(
            "/floor",
            image,
            columns * floor.cell_m,
            rows * floor.cell_m,
            format="png",
            cast_shadow=False,
            receive_shadow=False,
            position=(*(floor.lower + np.array([columns, rows]) * floor.cell_m / 2), self.drawn_m),
            visible=bool(self.controls.shown["floor"].value),
        )
        self._floor = floor

    def judge(self, state: ViewState) -> Iterator[None]:
        """Draw the labelled views, and say where the prediction was wrong."""
        table = self.shared.opened.labels
        if table is None or not self.controls.shown["labels"].value:
            self.scene.remove_by_name("/labels")
            self.controls.judged.content = ""
            return
        scorer = self.shared.look(state.method, state.occlusion).scorer
        told = yield from judged_labels(scorer, table, LIMITS[self.controls.limits.value], state.threshold)
        colors = np.where(told.good[:, None], drawing.GOOD, drawing.BAD)
        text = f"{len(told.good):,} labelled views, {100 * told.good.mean():.0f} % localize."
        if self.shared.is_probability(state.method):
            colors[told.promised] = drawing.PROMISED
            colors[told.missed] = drawing.MISSED
            text += f" Wrong at {state.threshold:.2f}: {told.promised.sum()} promised and lost (orange), "
            text += f"{told.missed.sum()} localized against it (blue)."
        segments = drawing.label_arrows(told.positions, told.axes, colors, self.shared.mark_m)
        self.scene.add_line_segments("/labels", *segments, thickness=2.0, thickness_units="screen")
        self.controls.judged.content = text


def _shown(drawn: list[int], less: int) -> int:
    """Which of the clouds that are drawn is shown."""
    return max((n for n in drawn if n <= less), default=0)


def _cloud(less: int) -> str:
    """The name of all landmarks (0), or of some of them."""
    return f"/landmarks-{less}" if less else "/landmarks"
