"""How many landmarks are in view at every location in every direction (paper, Sec. 3.2), exactly and fast."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import Camera, ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.warp import start_warp
from wheretolook.visibility import counting_kernel, frustum
from wheretolook.visibility.field_of_view import tabulate
from wheretolook.visibility.sphere_cells import SphereCells, choose_size

GPU_LANES = 16  # threads that share a location and an orientation on a GPU
UNSURE_BYTES = 20  # of a landmark on the list of those that the table of a field of view cannot decide


class FrustumCounter:
    """Counts the landmarks in view from any location, for a fixed set of orientations.

    The landmarks around a location are sorted into cells of the sphere of directions (`SphereCells`). A cell wholly in
    view counts with all its landmarks; landmarks are tested one by one only in cells on the border of the view.

    `rotations` (D, 3, 3) are cam_from_world; `device` is "cpu" or a CUDA device. `n_points`, about how many landmarks
    will be counted, sets the number of cells, unless `size` gives the even number of cells along a side of the sphere's map.
    `scratch_bytes` is the memory for lists of landmarks that a COLMAP camera itself must project. Raises ConfigError if
    there is no such device.
    """

    def __init__(
        self,
        camera: Camera,
        rotations: Float,
        n_points: int,
        device: str = "cpu",
        size: int | None = None,
        scratch_bytes: int = 1 << 28,
    ) -> None:
        self.camera = camera
        self.scratch_bytes = scratch_bytes
        self.rotations = np.asarray(rotations, dtype=np.float32)
        self.device = start_warp(device)
        wp.load_module(counting_kernel, device=self.device)  # only one thread may do that
        self.lanes = GPU_LANES if wp.get_device(self.device).is_cuda else 1
        self._field = tabulate(camera) if isinstance(camera, ColmapCamera) else None
        self.size = size or choose_size(n_points, len(self.rotations))
        self.cells = SphereCells.of(camera, rotations, self.size, self.device)
        self._axes: Any = wp.array(self.rotations, dtype=wp.mat33, device=self.device)
        self._near = 0.0
        if isinstance(camera, PinholeCamera):
            sides = frustum.frustum_sides(camera, rotations)
            self._sides: Any = wp.array(sides, dtype=wp.vec3, device=self.device)
            self._rounding = frustum.sides_rounding(sides)
            self._near = frustum.near_radius_m(camera)
        elif self._field is not None:
            self._depth: Any = wp.array(self._field.depth_rad, dtype=wp.float32, device=self.device)

    def bytes_per_location(self, n_points: int) -> int:
        """Memory in bytes that `count` and the ranking of its result take for each location."""
        return n_points * (8 + 12) + (self.size**2 + 1) * 8 + len(self.rotations) * (4 + 4 + 8 + 8)

    @property
    def fixed_bytes(self) -> int:
        """Memory in bytes that `count` takes for any number of locations."""
        return self.scratch_bytes if isinstance(self.camera, ColmapCamera) else 0

    def max_locations(self, n_points: int) -> int:
        """The most locations that `count` takes at a time: entries are numbered by int32."""
        return int(np.iinfo(np.int32).max // max(n_points, self.size**2 + 1)) - 1

    def count(self, locations: ArrayLike, points: Any, unoccluded: Any | None = None) -> Any:
        """Counts (L, D), int32, from camera centres (L, 3) in the world, metres.

        Counts, landmarks (N,) of vec3d and mask (L, N) of bool are Warp arrays on the device; without a mask all lines
        of sight are free. Raises a ConfigError for more than `max_locations`; `survey` divides them into blocks.
        """
        at = np.asarray(locations, dtype=np.float64).reshape(-1, 3)
        if len(at) > (most := self.max_locations(points.shape[0])):
            raise ConfigError("too many locations at once", value=len(at), fix=f"Give at most {most}, or use survey.")
        counts: Any = wp.zeros((len(at), len(self.rotations)), dtype=wp.int32, device=self.device)
        landmarks, _ = self._sorted(at, points, unoccluded)
        return self._count_sorted(landmarks, counts)

    def _count_sorted(self, landmarks: Any, counts: Any) -> Any:
        """Add what is in view to counts (L, D) of zeros, by landmarks sorted into cells."""
        if self._field is not None:
            return self._count_by_field(landmarks, counts)
        inputs = [self._sides, landmarks, self._rounding, wp.float64(frustum.MIN_DEPTH_M), self.lanes]
        wp.launch(counting_kernel.count_kernel, (*counts.shape, self.lanes), inputs, [counts], device=self.device)
        return counts

    def _sorted(self, at: Float, points: Any, unoccluded: Any | None) -> tuple[Any, Any]:
        """Landmarks sorted into cells around locations (L, 3), and their places (L, N), see `cell_kernel`."""
        device = self.device
        n_cells = self.size**2 + 1
        shape = (len(at), points.shape[0])
        centers: Any = wp.array(at, dtype=wp.vec3d, device=device)
        places: Any = wp.empty(shape, dtype=wp.vec2i, device=device)
        numbers: Any = wp.zeros(len(at) * n_cells + 1, dtype=wp.int32, device=device)
        mask = wp.empty((0, 0), dtype=wp.bool, device=device) if unoccluded is None else unoccluded
        inputs = [centers, points, unoccluded is not None, mask, self.size, self._near]
        wp.launch(counting_kernel.cell_kernel, shape, inputs, [places, numbers], device=device)
        starts: Any = wp.empty_like(numbers)
        wp.utils.array_scan(numbers, starts, inclusive=False)
        offsets: Any = wp.empty(max(1, shape[0] * shape[1]), dtype=wp.vec3, device=device)
        inputs = [centers, points, places, starts, self.size]
        wp.launch(counting_kernel.sort_kernel, shape, inputs, [offsets], device=device)
        landmarks: Any = counting_kernel.SortedLandmarks()
        landmarks.size = self.size
        landmarks.starts = starts
        landmarks.offsets = offsets
        landmarks.inside_starts = self.cells.inside.starts
        landmarks.inside = self.cells.inside.cells
        landmarks.border_starts = self.cells.border.starts
        landmarks.border = self.cells.border.cells
        return landmarks, places

    def _count_by_field(self, landmarks: Any, counts: Any) -> Any:
        assert self._field is not None
        device = self.device
        shared = [self._axes, self._depth, self._field.size, landmarks]
        views = counts.flatten()
        n_views = counts.shape[0] * counts.shape[1]
        capacity = max(1, self.scratch_bytes // UNSURE_BYTES)
        first = 0
        block = n_views
        number: Any = wp.empty(1, dtype=wp.int32, device=device)
        pairs, unsure = self._unsure_lists(capacity)
        while first < n_views:
            block = min(block, n_views - first)
            number.zero_()
            inputs = [*shared, first, self.lanes]
            outputs = [counts, number, pairs, unsure]
            wp.launch(counting_kernel.count_field_kernel, (block, self.lanes), inputs, outputs, device=device)
            n = int(number.numpy()[0])
            if n <= capacity:
                self._ask_camera(pairs[:n].numpy(), unsure[:n].numpy(), counts)
                first += block
                continue
            # The list was too short: again with fewer views, or with a longer list if there is one view only.
            views[first : first + block].zero_()
            if block == 1:
                capacity = n
                pairs, unsure = self._unsure_lists(n)
            block = max(1, block * capacity // (2 * n))
        return counts

    def _unsure_lists(self, capacity: int) -> tuple[Any, Any]:
        """Room for the pairs of location and orientation, and the offsets, of landmarks that the table leaves open."""
        pairs, unsure = (wp.empty(capacity, dtype=dtype, device=self.device) for dtype in (wp.vec2i, wp.vec3))
        return pairs, unsure

    def _ask_camera(self, pairs: NDArray[np.int32], offsets: NDArray[np.float32], counts: Any) -> None:
        """Add the offsets (n, 3) that the camera sees to the counts of their pairs (n, 2), location and orientation."""
        assert isinstance(self.camera, ColmapCamera)
        more = np.zeros(counts.shape, dtype=np.int32)
        location, orientation = pairs.T
        seen = frustum.camera_sees(self.camera, self.rotations, orientation, offsets)
        np.add.at(more, (location[seen], orientation[seen]), 1)
        wp.copy(counts, wp.array(counts.numpy() + more, dtype=wp.int32, device=self.device))
