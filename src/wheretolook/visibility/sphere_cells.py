"""Cells of the sphere of directions, and which of them lie inside, outside or on the border of each view.

Whether a direction is in view does not depend on the location. So the sphere is cut into cells once, and every
orientation's cells are sorted into those wholly in view, whose landmarks count without a test, those wholly out of
view, and those on the border, whose landmarks are tested one by one: a few per cent of all.

The cells are the squares of an octahedral map. Within a face of the octahedron a cell is the cone over a planar
quadrilateral, so that a plane through the centre has it on one side if it has its corners there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from wheretolook.geometry.colmap_camera import Camera, ColmapCamera
from wheretolook.geometry.poses import Float
from wheretolook.visibility.field_of_view import FieldOfView
from wheretolook.visibility.frustum import frustum_sides
from wheretolook.visibility.octahedral_map import cell_centers, octahedral_directions
from wheretolook.visibility.sphere_cells_kernel import (
    BORDER,
    INSIDE,
    classify_field_kernel,
    classify_pinhole_kernel,
    count_runs_kernel,
    write_runs_kernel,
)

ROUNDING = 1e-5
"""A cell's corners must be this far (relative) from a plane: a landmark on its edge may be rounded out of the cell."""


def choose_size(n_points: int) -> int:
    """Cells along a side of the map, a multiple of two, for about six landmarks a cell, found best on CPU and GPU."""
    return int(np.clip(2 * round(np.sqrt(n_points / 6) / 2), 8, 256))


@dataclass(frozen=True, eq=False)
class CellRuns:
    """Runs of neighbouring cells for each of D orientations, on a device.

    Attributes:
        starts: (D * size + 1,) int32; orientation d has the runs from `starts[d * size]` to `starts[(d + 1) * size]`.
        cells: (n,) pairs of int32: the first cell of a run, and the one after its last.
    """

    starts: Any
    cells: Any


@dataclass(frozen=True, eq=False)
class SphereCells:
    """The cells of D orientations, on a device.

    Attributes:
        size: cells along a side of the map; there are size * size.
        inside: runs of cells wholly in view.
        border: runs of cells that are partly in view, or may be.
    """

    size: int
    inside: CellRuns
    border: CellRuns

    @classmethod
    def of(cls, camera: Camera, rotations: Float, size: int, device: str) -> SphereCells:
        """Sort the cells, size along a side of the map, of orientations (D, 3, 3) cam_from_world on a Warp device."""
        shape = (len(rotations), size * size)
        classes: Any = wp.empty(shape, dtype=wp.uint8, device=device)
        if isinstance(camera, ColmapCamera):
            field = FieldOfView.of(camera)
            centers, radii = cell_centers(size)
            inputs: list[Any] = [
                wp.array(np.asarray(rotations, dtype=np.float32), dtype=wp.mat33, device=device),
                wp.array(centers.astype(np.float32), dtype=wp.vec3, device=device),
                wp.array(field.depth_rad, dtype=wp.float32, device=device), field.size, float(radii.max()) + ROUNDING,
            ]  # fmt: skip
            wp.launch(classify_field_kernel, shape, inputs, [classes], device=device)
        else:
            edge = np.arange(size + 1) / size * 2 - 1
            corners = octahedral_directions(edge[None, :], edge[:, None]).reshape(-1, 3).astype(np.float32)
            sides = frustum_sides(camera, rotations)
            inputs = [
                wp.array(sides, dtype=wp.vec3, device=device), wp.array(corners, dtype=wp.vec3, device=device), size,
                float(ROUNDING * np.linalg.norm(sides, axis=-1).max(initial=0)),
            ]  # fmt: skip
            wp.launch(classify_pinhole_kernel, shape, inputs, [classes], device=device)
        return cls(size, _runs(classes, size, INSIDE), _runs(classes, size, BORDER))


def _runs(classes: Any, size: int, wanted: int) -> CellRuns:
    device, rows = classes.device, (classes.shape[0], size)
    n_rows = rows[0] * rows[1]
    numbers: Any = wp.zeros(n_rows + 1, dtype=wp.int32, device=device)
    wp.launch(count_runs_kernel, rows, [classes, size, wanted], [numbers], device=device)
    starts: Any = wp.empty(n_rows + 1, dtype=wp.int32, device=device)
    wp.utils.array_scan(numbers, starts, inclusive=False)
    cells: Any = wp.empty(int(starts[n_rows:].numpy()[0]), dtype=wp.vec2i, device=device)
    wp.launch(write_runs_kernel, rows, [classes, size, wanted, starts], [cells], device=device)
    return CellRuns(starts, cells)
