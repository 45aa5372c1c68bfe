"""How many landmarks every location sees in every direction (paper, Sec. 3.2), exactly and fast."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.colmap_camera import Camera, ColmapCamera
from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.warp import start_warp
from wheretolook.visibility import counting_kernel, pixel_kernel
from wheretolook.visibility.counting_kernel import (
    SortedLandmarks,
    cell_kernel,
    count_field_kernel,
    count_kernel,
    sort_kernel,
)
from wheretolook.visibility.field_of_view import FieldOfView
from wheretolook.visibility.frustum import (
    MIN_DEPTH_M,
    frustum_sides,
    in_view,
    near_radius_m,
    offsets_from,
    pixels_of,
    rotate,
)
from wheretolook.visibility.pixel_kernel import count_pixels_kernel
from wheretolook.visibility.sphere_cells import SphereCells, choose_size

SINGLE_ROUNDING = 5e-7
"""Bound on the relative error of a product of two vectors of three float32, with room to spare (3 * 2^-24)."""

GPU_LANES = 16
"""Threads that share a location and an orientation on a GPU."""

UNSURE_BYTES = 20
"""A landmark on the list of those that the table of a field of view cannot decide."""

ASKED_AT_ONCE = 1 << 18
"""Of these, how many a COLMAP camera projects at a time."""


class FrustumCounter:
    """Counts the landmarks in view of a fixed set of orientations from any location.

    The landmarks around a location are sorted into cells of the sphere of directions (`SphereCells`); cells wholly in
    view are counted by their number of landmarks and only landmarks of cells on the border are tested.

    Args:
        camera: pinhole, or any COLMAP model.
        rotations: (D, 3, 3) cam_from_world.
        n_points: about how many landmarks will be counted, which sets the number of cells.
        device: "cpu" or a CUDA device.
        distinct_pixels: count pixels that see a landmark instead of landmarks, the released code's rule; it says to
            take the first landmark that falls on a pixel and leave out the others. With a COLMAP camera these are
            counted in NumPy, thousands of times slower.
        size: cells along a side of the sphere's map, instead of what suits `n_points`.
        scratch_bytes: memory for the bitmaps of distinct pixels, or for lists of landmarks that a COLMAP camera must be
            asked about.

    Raises:
        ConfigError: no such device, a size that is not even, or rotations that are not finite or of another shape.
    """

    def __init__(
        self,
        camera: Camera,
        rotations: Float,
        n_points: int,
        device: str = "cpu",
        distinct_pixels: bool = False,
        size: int | None = None,
        scratch_bytes: int = 1 << 28,
    ) -> None:
        self.camera, self.distinct_pixels, self.scratch_bytes = camera, distinct_pixels, scratch_bytes
        self.rotations = np.asarray(rotations, dtype=np.float32)
        if self.rotations.shape[1:] != (3, 3) or not np.isfinite(self.rotations).all():
            raise ConfigError("rotations must be finite and of shape (D, 3, 3)", value=self.rotations.shape)
        if size is not None and (size < 2 or size % 2):
            raise ConfigError("the sphere's map needs an even number of cells along a side", value=size)
        self.device = start_warp(device)
        for module in (counting_kernel, pixel_kernel):
            wp.load_module(module, device=self.device)  # only one thread may do that
        self.lanes = GPU_LANES if wp.get_device(self.device).is_cuda else 1
        on_host = isinstance(camera, ColmapCamera) and distinct_pixels
        self._field = FieldOfView.of(camera) if isinstance(camera, ColmapCamera) and not on_host else None
        self.size = size or choose_size(n_points)
        if not on_host:
            self.cells = SphereCells.of(camera, rotations, self.size, self.device)
        self._axes: Any = wp.array(self.rotations, dtype=wp.mat33, device=self.device)
        self._near = 0.0
        if isinstance(camera, PinholeCamera):
            sides = frustum_sides(camera, rotations)
            self._sides: Any = wp.array(sides, dtype=wp.vec3, device=self.device)
            self._rounding = float(SINGLE_ROUNDING * np.linalg.norm(sides[:, :4], axis=-1).max(initial=0))
            self._near = near_radius_m(camera)
        elif self._field is not None:
            self._depth: Any = wp.array(self._field.depth_rad, dtype=wp.float32, device=self.device)

    def bytes_per_location(self, n_points: int) -> int:
        """Memory that `count` and the ranking of its result take for each location."""
        return n_points * (8 + 12) + (self.size**2 + 1) * 8 + len(self.rotations) * (4 + 4 + 8 + 8)

    def serves(self, camera: Camera, rotations: Float, distinct_pixels: bool, device: str) -> bool:
        """Whether it counts for this camera, these rotations and this rule on this device."""
        same = (camera, distinct_pixels, device) == (self.camera, self.distinct_pixels, self.device)
        return same and np.array_equal(np.asarray(rotations, dtype=np.float32), self.rotations)

    @property
    def fixed_bytes(self) -> int:
        """Memory that `count` takes for any number of locations."""
        return self.scratch_bytes if self.distinct_pixels or isinstance(self.camera, ColmapCamera) else 0

    def max_locations(self, n_points: int) -> int:
        """Locations that `count` takes at a time: entries are numbered by int32."""
        return int(np.iinfo(np.int32).max // max(n_points, self.size**2 + 1)) - 1

    def count(self, locations: ArrayLike, points: Any, unoccluded: Any | None = None) -> Any:
        """Count from locations (L, 3) m.

        Args:
            locations: camera centres in the world, metres.
            points: (N,) landmarks, a Warp array of vec3d on the device.
            unoccluded: (L, N) Warp array of bool on the device; None where every line of sight is free.

        Returns:
            (L, D) counts, a Warp array of int32 on the device.

        Raises:
            ConfigError: these are more than `max_locations`; `survey` divides them into blocks.
        """
        at = np.asarray(locations, dtype=np.float64).reshape(-1, 3)
        if len(at) > self.max_locations(points.shape[0]):
            raise ConfigError("too many locations at once", value=len(at),
                              fix=f"Give at most {self.max_locations(points.shape[0])}, or use survey.")  # fmt: skip
        if isinstance(self.camera, ColmapCamera) and self.distinct_pixels:
            return self._count_on_host(at, points, unoccluded)
        device, n_cells, shape = self.device, self.size**2 + 1, (len(at), points.shape[0])
        counts: Any = wp.zeros((len(at), len(self.rotations)), dtype=wp.int32, device=device)
        centers: Any = wp.array(at, dtype=wp.vec3d, device=device)
        places: Any = wp.empty(shape, dtype=wp.vec2i, device=device)
        numbers: Any = wp.zeros(len(at) * n_cells + 1, dtype=wp.int32, device=device)
        mask = wp.empty((0, 0), dtype=wp.bool, device=device) if unoccluded is None else unoccluded
        wp.launch(cell_kernel, shape, [centers, points, unoccluded is not None, mask, self.size, self._near],
                  [places, numbers], device=device)  # fmt: skip
        starts: Any = wp.empty_like(numbers)
        wp.utils.array_scan(numbers, starts, inclusive=False)
        offsets: Any = wp.empty(max(1, shape[0] * shape[1]), dtype=wp.vec3, device=device)
        wp.launch(sort_kernel, shape, [centers, points, places, starts, self.size], [offsets], device=device)
        in_cells = self._sorted(starts, offsets)
        if isinstance(self.camera, ColmapCamera):
            return self._count_by_field(in_cells, counts)
        if self.distinct_pixels:
            return self._count_pixels(in_cells, counts)
        inputs = [self._sides, in_cells, self._rounding, wp.float64(MIN_DEPTH_M)]
        wp.launch(count_kernel, (*counts.shape, self.lanes), [*inputs, self.lanes], [counts], device=device)
        return counts

    def _sorted(self, starts: Any, offsets: Any) -> Any:
        landmarks: Any = SortedLandmarks()
        landmarks.size, landmarks.starts, landmarks.offsets = self.size, starts, offsets
        landmarks.inside_starts, landmarks.inside = self.cells.inside.starts, self.cells.inside.cells
        landmarks.border_starts, landmarks.border = self.cells.border.starts, self.cells.border.cells
        return landmarks

    def _count_pixels(self, landmarks: Any, counts: Any) -> Any:
        assert isinstance(self.camera, PinholeCamera)
        camera, n_views = self.camera, counts.shape[0] * counts.shape[1]
        words = (camera.width * camera.height + 31) // 32
        block = min(n_views, max(1, self.scratch_bytes // (words * 4)))
        bits: Any = wp.empty((block, words), dtype=wp.uint32, device=self.device)
        inputs = [
            self._sides, self._axes, landmarks, wp.float64(camera.focal_px), wp.float64(camera.cx),
            wp.float64(camera.cy), camera.width, camera.height, wp.float64(MIN_DEPTH_M),
        ]  # fmt: skip
        for first in range(0, n_views, block):
            bits.zero_()
            shape = (min(block, n_views - first), self.lanes)
            wp.launch(count_pixels_kernel, shape, [*inputs, first, self.lanes], [bits, counts], device=self.device)
        return counts

    def _count_by_field(self, landmarks: Any, counts: Any) -> Any:
        assert self._field is not None
        inputs = [self._axes, self._depth, self._field.size, landmarks]
        views, n_views = counts.flatten(), counts.shape[0] * counts.shape[1]
        capacity, first, block = max(1, self.scratch_bytes // UNSURE_BYTES), 0, n_views
        number: Any = wp.empty(1, dtype=wp.int32, device=self.device)
        pairs: Any = wp.empty(capacity, dtype=wp.vec2i, device=self.device)
        unsure: Any = wp.empty(capacity, dtype=wp.vec3, device=self.device)
        while first < n_views:
            block = min(block, n_views - first)
            number.zero_()
            outputs = [counts, number, pairs, unsure]
            wp.launch(
                count_field_kernel, (block, self.lanes), [*inputs, first, self.lanes], outputs, device=self.device
            )
            n = int(number.numpy()[0])
            if n > capacity:  # fewer views at a time, or a longer list where that is one already
                views[first : first + block].zero_()
                if block == 1:
                    capacity = n
                    pairs = wp.empty(capacity, dtype=wp.vec2i, device=self.device)
                    unsure = wp.empty(capacity, dtype=wp.vec3, device=self.device)
                block = max(1, block * capacity // (2 * n))
                continue
            self._ask_camera(pairs[:n].numpy(), unsure[:n].numpy(), counts)
            first += block
        return counts

    def _ask_camera(self, pairs: NDArray[np.int32], offsets: NDArray[np.float32], counts: Any) -> None:
        """Add those of the offsets (n, 3) that the camera sees to the counts of their pairs (n, 2)."""
        assert isinstance(self.camera, ColmapCamera)
        more = np.zeros(counts.shape, dtype=np.int32)
        for start in range(0, len(pairs), ASKED_AT_ONCE):
            location, orientation = pairs[start : start + ASKED_AT_ONCE].T
            seen = self.camera.sees(rotate(self.rotations[orientation], offsets[start : start + ASKED_AT_ONCE]))
            np.add.at(more, (location[seen], orientation[seen]), 1)
        wp.copy(counts, wp.array(counts.numpy() + more, dtype=wp.int32, device=self.device))

    def _count_on_host(self, locations: Float, points: Any, unoccluded: Any | None) -> Any:
        mask = np.ones((len(locations), points.shape[0]), bool) if unoccluded is None else unoccluded.numpy()
        counts = count_plain(self.camera, self.rotations, locations, points.numpy(), mask, self.distinct_pixels)
        return wp.array(counts, dtype=wp.int32, device=self.device)


def count_plain(
    camera: Camera,
    rotations: ArrayLike,
    locations: ArrayLike,
    points: ArrayLike,
    unoccluded: NDArray[np.bool_],
    distinct_pixels: bool = False,
) -> NDArray[np.int32]:
    """What `FrustumCounter.count` computes, in NumPy: every landmark against every orientation.

    Args:
        camera: pinhole, or any COLMAP model.
        rotations: (D, 3, 3) cam_from_world.
        locations: (L, 3) camera centres in the world, metres.
        points: (N, 3) landmarks in metres.
        unoccluded: (L, N), True where the line of sight is free.
        distinct_pixels: count pixels that see a landmark instead of landmarks.

    Returns:
        (L, D).
    """
    rotations, points = np.asarray(rotations), np.asarray(points)
    counts = np.zeros((len(unoccluded), len(rotations)), dtype=np.int32)
    for row, location in enumerate(np.asarray(locations)):
        offsets = offsets_from(location, points[unoccluded[row]])
        seen = in_view(camera, rotations, offsets)
        if not distinct_pixels:
            counts[row] = seen.sum(-1)
            continue
        for orientation, rotation in enumerate(rotations.astype(np.float32)):
            pixels = np.floor(pixels_of(camera, rotate(rotation, offsets[seen[orientation]])))
            column, line = np.clip(pixels, 0, (camera.width - 1, camera.height - 1)).T
            counts[row, orientation] = len(np.unique(line * camera.width + column))
    return counts
