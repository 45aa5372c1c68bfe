"""Cells of the sphere of directions, and which of them lie inside, outside or on the border of each view.

Whether a direction is in view does not depend on the location. So the sphere is cut into cells once, and for every
orientation the cells are sorted into those wholly in view, whose landmarks count without a test, those wholly out of
view, and those on the border, whose landmarks are tested one by one: a few per cent of all.

The cells are the squares of an octahedral map. Within a face of the octahedron a cell is the cone over a planar
quadrilateral. So it is on one side of a plane through the centre if its corners do.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from wheretolook.geometry.camera import Camera, ColmapCamera
from wheretolook.geometry.poses import Float
from wheretolook.visibility import counting_kernel as kernels
from wheretolook.visibility.field_of_view import cell_centers, octahedral_directions, tabulate
from wheretolook.visibility.frustum import frustum_sides

ROUNDING = 1e-5  # least relative distance of a cell's corners from a plane, since rounding may move landmarks into it


MOST_CELLS = 1 << 28  # of all orientations together, a byte each while they are classified


def choose_size(n_points: int, n_rotations: int = 1) -> int:
    """Cells along a side of the map, an even number. About six landmarks a cell were fastest on CPU and GPU.

    Fewer where the cells of very many orientations would take too much memory.
    """
    most = min(256, 2 * int(np.sqrt(MOST_CELLS / max(n_rotations, 1)) / 2))
    return int(np.clip(2 * round(np.sqrt(n_points / 6) / 2), 8, max(8, most)))


@dataclass(frozen=True, eq=False)
class CellRuns:
    """Runs of neighbouring cells for each of D orientations, on a device."""

    starts: Any  # (D * size + 1,) int32; orientation d has the runs from `starts[d * size]` to `starts[(d + 1) * size]`
    cells: Any  # (n,) pairs of int32: the first cell of a run, and the one after its last


@dataclass(frozen=True, eq=False)
class SphereCells:
    """The cells of D orientations, on a device."""

    size: int  # cells along a side of the map; there are size * size
    inside: CellRuns  # runs of cells wholly in view
    border: CellRuns  # runs of cells that are partly in view, or may be

    @classmethod
    def of(cls, camera: Camera, rotations: Float, size: int, device: str) -> SphereCells:
        """Classify the cells, `size` along a side, for rotations (D, 3, 3) cam_from_world, on a Warp device."""
        shape = (len(rotations), size * size)
        classes: Any = wp.empty(shape, dtype=wp.uint8, device=device)

        def upload(values: Float, dtype: Any) -> Any:
            return wp.array(np.asarray(values, dtype=np.float32), dtype=dtype, device=device)

        if isinstance(camera, ColmapCamera):
            field = tabulate(camera)
            centers, radii = cell_centers(size)
            arrays = [upload(rotations, wp.mat33), upload(centers, wp.vec3), upload(field.depth_rad, wp.float32)]
            inputs = [*arrays, field.size, float(radii.max()) + ROUNDING]
            wp.launch(kernels.classify_field_kernel, shape, inputs, [classes], device=device)
        else:
            edge = np.arange(size + 1) / size * 2 - 1
            corners = octahedral_directions(edge[None, :], edge[:, None]).reshape(-1, 3)
            sides = frustum_sides(camera, rotations)
            margin = float(ROUNDING * np.linalg.norm(sides, axis=-1).max(initial=0))
            inputs = [upload(sides, wp.vec3), upload(corners, wp.vec3), size, margin]
            wp.launch(kernels.classify_pinhole_kernel, shape, inputs, [classes], device=device)
        return cls(size, *_runs(classes, size))


def _runs(classes: Any, size: int) -> tuple[CellRuns, CellRuns]:
    """Runs of cells of the classes INSIDE and BORDER, from the classes (D, size * size) of all cells."""
    device = classes.device
    shape = (2, classes.shape[0], size)
    n_rows = classes.shape[0] * size
    numbers: Any = wp.zeros(2 * n_rows + 1, dtype=wp.int32, device=device)
    none: list[Any] = [wp.empty(0, dtype=dtype, device=device) for dtype in (wp.int32, wp.vec2i)]
    inputs = [classes, classes.shape[0], size]
    wp.launch(kernels.runs_kernel, shape, [*inputs, False, none[0]], [numbers, none[1]], device=device)
    starts: Any = wp.empty_like(numbers)
    wp.utils.array_scan(numbers, starts, inclusive=False)
    cells: Any = wp.empty(int(starts[2 * n_rows :].numpy()[0]), dtype=wp.vec2i, device=device)
    wp.launch(kernels.runs_kernel, shape, [*inputs, True, starts], [numbers, cells], device=device)
    return CellRuns(starts[: n_rows + 1], cells), CellRuns(starts[n_rows:], cells)
