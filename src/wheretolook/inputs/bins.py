"""Warp kernels of `bin_views` and `count_bins`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import split_poses
from wheretolook.inputs.channels import ALL_CHANNELS, CHANNELS
from wheretolook.mapping.landmarks import MAP_ATTRIBUTES, Landmarks
from wheretolook.utils.warp import start_warp
from wheretolook.visibility import frustum
from wheretolook.visibility.frustum import PosedViews
from wheretolook.visibility.frustum_kernel import ViewBatch, dot, entry_offset, in_view, pixel_of

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.


wp.set_module_options({"enable_backward": False, "fuse_fp": False})  # the latter for `pixel_of`

MAPPED_DISTANCE = wp.constant(MAP_ATTRIBUTES.index("mapped_distance"))


@wp.struct
class BinGrid:
    """A grid of bins x bins cells over a pinhole's image, and how B views are turned."""

    rotations: wp.array[wp.mat33]  # (B,) cam_from_world
    focal: wp.vec2d  # pixels
    center: wp.vec2d  # principal point, pixels
    columns_per_pixel: wp.float64
    rows_per_pixel: wp.float64
    bins: wp.int32


@wp.func
def pixel_in(grid: BinGrid, view: wp.int32, offset: wp.vec3) -> wp.vec2d:
    return pixel_of(grid.rotations[view], offset, grid.focal, grid.center)


@wp.func
def cell_of(grid: BinGrid, pixel: wp.vec2d) -> wp.int32:
    """Cell that a pixel falls into, counted row by row."""
    column = wp.clamp(wp.int32(pixel[0] * grid.columns_per_pixel), 0, grid.bins - 1)
    row = wp.clamp(wp.int32(pixel[1] * grid.rows_per_pixel), 0, grid.bins - 1)
    return row * grid.bins + column


@wp.kernel
def bin_kernel(
    views: ViewBatch,
    grid: BinGrid,
    directions: wp.array[wp.vec3],
    attributes: wp.array2d[wp.float32],  # (0, .) if they are not asked for
    means: wp.array3d[wp.float32],
    counts: wp.array2d[wp.int32],
):
    """Number of landmarks in each cell of each view, and the mean of their channels."""
    view = wp.tid()
    rotation = grid.rotations[view]
    location = views.location_rows[view]
    for entry in range(views.starts[location], views.starts[location + 1]):
        landmark = views.unoccluded[entry]
        offset = entry_offset(views, view, entry)
        if in_view(views.sides, view, offset, views.min_depth):
            pixel = pixel_in(grid, view, offset)
            cell = cell_of(grid, pixel)
            counts[view, cell] = counts[view, cell] + 1
            means[view, 0, cell] = means[view, 0, cell] + wp.float32(pixel[0])
            means[view, 1, cell] = means[view, 1, cell] + wp.float32(pixel[1])
            for axis in range(3):
                means[view, 2 + axis, cell] = means[view, 2 + axis, cell] + wp.float32(dot(rotation[axis], offset))
            if attributes.shape[0] > 0:
                distance = wp.sqrt(dot(offset, offset))
                angle = wp.float32(dot(offset, directions[landmark]) / distance)
                ratio = wp.float32(wp.log(distance) - wp.float64(attributes[landmark, MAPPED_DISTANCE]))
                means[view, 5, cell] = means[view, 5, cell] + angle
                means[view, 6, cell] = means[view, 6, cell] + ratio
                for attribute in range(attributes.shape[1]):
                    value = attributes[landmark, attribute]
                    means[view, 7 + attribute, cell] = means[view, 7 + attribute, cell] + value
    for cell in range(grid.bins * grid.bins):
        if counts[view, cell] > 1:
            scale = 1.0 / wp.float32(counts[view, cell])
            for channel in range(means.shape[1]):
                means[view, channel, cell] = means[view, channel, cell] * scale


@wp.kernel
def count_bins_kernel(
    views: ViewBatch,
    grid: BinGrid,
    lanes: wp.int32,
    occupied: wp.array2d[wp.int32],  # 0 where no landmark has been seen in a bin yet
    n_in_view: wp.array[wp.int32],
    n_filled: wp.array[wp.int32],
):
    """Number of landmarks in each view, and of bins with at least one. Several threads (lanes) share a view."""
    view, lane = wp.tid()
    location = views.location_rows[view]
    seen = wp.int32(0)
    filled = wp.int32(0)
    for entry in range(views.starts[location] + lane, views.starts[location + 1], lanes):
        offset = entry_offset(views, view, entry)
        if in_view(views.sides, view, offset, views.min_depth):
            seen += 1
            # whichever lane comes first fills the bin, so the numbers do not depend on the lanes' order
            if wp.atomic_max(occupied, view, cell_of(grid, pixel_in(grid, view, offset)), 1) == 0:
                filled += 1
    wp.atomic_add(n_in_view, view, seen)
    wp.atomic_add(n_filled, view, filled)


BLOCK_BYTES = 1 << 30  # of bins that are computed at a time


@dataclass(frozen=True, eq=False)
class BinnedViews:
    """Landmarks of a batch of views, binned."""

    # (B, C, bins, bins) float32, mean of each channel over a bin's landmarks, zero where there are none, NaN where a
    # landmark's value is not known. Rows go down the image, columns right.
    means: NDArray[np.float32]
    counts: NDArray[np.int32]  # (B, bins, bins) landmarks in each bin
    channels: tuple[str, ...]  # names of the C channels

    def __len__(self) -> int:
        return len(self.means)

    @property
    def n_visible(self) -> NDArray[np.int32]:
        """Visible landmarks of each view, (B,)."""
        return self.counts.sum((1, 2), dtype=np.int32)

    @property
    def n_filled(self) -> NDArray[np.int32]:
        """Bins with at least one landmark, (B,)."""
        return (self.counts > 0).sum((1, 2), dtype=np.int32)

    def select(self, channels: tuple[str, ...]) -> BinnedViews:
        """Return the same views with only the named channels, in that order."""
        return BinnedViews(self.means[:, [self.channels.index(name) for name in channels]], self.counts, channels)


def bin_views(
    posed: PosedViews, bins: int = 30, device: str = "cpu", landmarks: Landmarks | None = None
) -> BinnedViews:
    """Bin the visible landmarks of each of B views in bins x bins cells, with all of `CHANNELS`.

    With the points' `landmarks`, the bins also have `LANDMARK_CHANNELS`, for about three times the memory. About
    `BLOCK_BYTES` of views are computed at a time, a view by one thread, so that sums do not depend on the order of
    threads; views of COLMAP cameras are computed on the CPU.
    """
    if isinstance(posed.camera, ColmapCamera):
        return bin_views_plain(posed, bins, landmarks)
    device = start_warp(device)
    channels = CHANNELS if landmarks is None else ALL_CHANNELS
    n_views = len(posed.cam_from_world)
    means = np.empty((n_views, len(channels), bins, bins), dtype=np.float32)
    counts = np.empty((n_views, bins, bins), dtype=np.int32)
    directions = np.empty((0, 3)) if landmarks is None else landmarks.mapping_direction
    attributes = np.empty((0, len(MAP_ATTRIBUTES))) if landmarks is None else landmarks.attributes()
    of_map: list[Any] = [
        wp.array(directions, dtype=wp.vec3, device=device),
        wp.array(attributes, dtype=wp.float32, device=device),
    ]
    for rows, views, grid in _blocks(posed, bins, device, len(channels) + 1):
        n = rows.stop - rows.start
        outputs = [
            wp.zeros((n, len(channels), bins * bins), dtype=wp.float32, device=device),
            wp.zeros((n, bins * bins), dtype=wp.int32, device=device),
        ]
        wp.launch(bin_kernel, n, [views, grid, *of_map], outputs, device=device)
        means[rows] = outputs[0].numpy().reshape(means[rows].shape)
        counts[rows] = outputs[1].numpy().reshape(counts[rows].shape)
    return BinnedViews(means, counts, channels)


def count_bins(posed: PosedViews, bins: int = 30, device: str = "cpu") -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return `n_visible` and `n_filled`, (B,) each, of the views that `bin_views` computes."""
    if isinstance(posed.camera, ColmapCamera):
        binned = bin_views_plain(posed, bins)
        return binned.n_visible, binned.n_filled
    device = start_warp(device)
    lanes = 32 if device != "cpu" else 1  # threads share a view
    numbers = np.empty((2, len(posed.cam_from_world)), dtype=np.int32)
    for rows, views, grid in _blocks(posed, bins, device, 1):
        n = rows.stop - rows.start
        occupied = wp.zeros((n, bins * bins), dtype=wp.int32, device=device)
        outputs = [wp.zeros(n, dtype=wp.int32, device=device) for _ in range(2)]
        wp.launch(count_bins_kernel, (n, lanes), [views, grid, lanes, occupied], outputs, device=device)
        numbers[:, rows] = [output.numpy() for output in outputs]
    return numbers[0], numbers[1]


def _blocks(posed: PosedViews, bins: int, device: str, n_values: int) -> Iterator[tuple[slice, Any, Any]]:
    """Yield blocks of views with `n_values` numbers a bin: the views' rows, and their `Views` and `BinGrid`."""
    camera = posed.camera
    poses = np.asarray(posed.cam_from_world)
    assert isinstance(camera, PinholeCamera)
    landmarks = frustum.points_on_device(posed.points, device)
    sets = frustum.sets_on_device(posed.unoccluded, device)
    block = max(1, BLOCK_BYTES // (bins * bins * n_values * 4))
    for begin in range(0, len(poses), block):
        rows = slice(begin, min(begin + block, len(poses)))
        grid: Any = BinGrid()
        grid.rotations = wp.array(poses[rows, :, :3].astype(np.float32), dtype=wp.mat33, device=device)
        grid.focal = wp.vec2d(camera.fx, camera.fy)
        grid.center = wp.vec2d(camera.cx, camera.cy)
        grid.bins = bins
        grid.columns_per_pixel = bins / camera.width
        grid.rows_per_pixel = bins / camera.height
        yield rows, frustum.views_on_device(posed, rows, landmarks, sets, device), grid


def bin_views_plain(posed: PosedViews, bins: int = 30, landmarks: Landmarks | None = None) -> BinnedViews:
    """Compute `bin_views` in NumPy, for any camera."""
    camera = posed.camera
    channels = CHANNELS if landmarks is None else ALL_CHANNELS
    attributes = None if landmarks is None else landmarks.attributes()
    n_views = len(posed.cam_from_world)
    n_cells = bins * bins
    means = np.zeros((n_views, len(channels), n_cells), dtype=np.float32)
    counts = np.zeros((n_views, n_cells), dtype=np.int32)
    per_pixel = np.array([bins / camera.width, bins / camera.height])
    rows = zip(*split_poses(posed.cam_from_world), posed.location_rows, strict=True)
    for view, (rotation, center, location) in enumerate(rows):
        candidates = posed.unoccluded[int(location)]
        offsets = frustum.offsets_from(center, posed.points[candidates])
        visible = frustum.in_view(camera, rotation[None], offsets)[0]
        offsets = offsets[visible]
        points_cam = frustum.rotate(rotation.astype(np.float32), offsets)
        pixels = frustum.pixels_of(camera, points_cam)
        column, row = np.clip((pixels * per_pixel).astype(int), 0, bins - 1).T
        cell = row * bins + column
        counts[view] = np.bincount(cell, minlength=n_cells)
        values = [*pixels.T, *points_cam.T]
        if landmarks is not None and attributes is not None:
            offsets = offsets.astype(np.float64)
            distance = np.linalg.norm(offsets, axis=1)
            along = (offsets * landmarks.mapping_direction[candidates[visible]]).sum(1)
            of_map = attributes[candidates[visible]]
            ratio = np.log(distance) - of_map[:, MAP_ATTRIBUTES.index("mapped_distance")]
            values += [along / distance, ratio, *of_map.T]
        for channel, weights in enumerate(values):
            means[view, channel] = np.bincount(cell, weights, minlength=n_cells) / np.maximum(counts[view], 1)
    return BinnedViews(means.reshape(n_views, -1, bins, bins), counts.reshape(n_views, bins, bins), channels)
