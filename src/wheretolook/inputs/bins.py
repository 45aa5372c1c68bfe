"""The network's input: visible landmarks, averaged in the cells of a grid over the image (paper, Sec. 3.3 "Data").

The pixel of a landmark decides its bin, one of 30 x 30. A bin has the mean of its landmarks' channels, and zero if it
is empty.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import split_poses
from wheretolook.inputs.bins_kernel import BinGrid, bin_kernel, count_bins_kernel
from wheretolook.inputs.channels import ALL_CHANNELS, CHANNELS
from wheretolook.mapping.attribute_names import MAP_ATTRIBUTES
from wheretolook.utils.warp import start_warp
from wheretolook.visibility import frustum
from wheretolook.visibility.frustum import PosedViews

if TYPE_CHECKING:
    from wheretolook.mapping.landmarks import Landmarks

GPU_LANES = 32  # threads that share a view on a GPU where bins are only counted
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
    lanes = GPU_LANES if device != "cpu" else 1
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
