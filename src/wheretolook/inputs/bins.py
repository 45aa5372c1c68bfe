"""The network's input: landmarks in view, averaged in the cells of a grid over the image (paper, Sec. 3.3 "Data").

Every landmark in view falls into one of 30 x 30 bins by its pixel. A bin holds the mean of its landmarks' channels, and
zero if it is empty.
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
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.warp import start_warp
from wheretolook.visibility import frustum
from wheretolook.visibility.frustum import PosedViews

if TYPE_CHECKING:
    from wheretolook.mapping.landmarks import Landmarks

GPU_LANES = 32  # threads that share a view on a GPU where bins are only counted


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
        """Landmarks each view sees, (B,)."""
        return self.counts.sum((1, 2), dtype=np.int32)

    @property
    def n_filled(self) -> NDArray[np.int32]:
        """Bins with at least one landmark, (B,)."""
        return (self.counts > 0).sum((1, 2), dtype=np.int32)

    def select(self, channels: tuple[str, ...]) -> BinnedViews:
        """The same views with only the named channels, in that order. Raises ConfigError if one is not there."""
        unknown = [name for name in channels if name not in self.channels]
        if unknown:
            raise ConfigError("unknown input channel", value=unknown[0], fix=f"There are {', '.join(self.channels)}.")
        return BinnedViews(self.means[:, [self.channels.index(name) for name in channels]], self.counts, channels)


def bin_views(
    posed: PosedViews,
    bins: int = 30,
    device: str = "cpu",
    block_bytes: int = 1 << 30,
    landmarks: Landmarks | None = None,
) -> BinnedViews:
    """Bin the landmarks in view of each of B views in bins x bins cells, with all of `CHANNELS`.

    With `landmarks`, those that the points are of, the bins also have `LANDMARK_CHANNELS`, for about three times the
    memory. About `block_bytes` of views are worked on at a time, a view by one thread, so that sums do not depend on
    the order of threads; COLMAP's cameras are computed on the CPU.
    """
    if isinstance(posed.camera, ColmapCamera):
        return bin_views_plain(posed, bins, landmarks)
    device = start_warp(device)
    channels = CHANNELS if landmarks is None else ALL_CHANNELS
    n_views = len(posed.cam_from_world)
    n_channels = len(channels)
    means = np.empty((n_views, n_channels, bins, bins), dtype=np.float32)
    counts = np.empty((n_views, bins, bins), dtype=np.int32)
    directions: Any = wp.empty(0, dtype=wp.vec3, device=device)
    attributes: Any = wp.empty((0, len(MAP_ATTRIBUTES)), dtype=wp.float32, device=device)
    if landmarks is not None:
        directions = wp.array(landmarks.mapping_direction, dtype=wp.vec3, device=device)
        attributes = wp.array(landmarks.attributes(), dtype=wp.float32, device=device)
    block = max(1, block_bytes // (bins * bins * (n_channels + 1) * 4))
    for rows, views, grid in _blocks(posed, bins, device, block):
        n = rows.stop - rows.start
        block_means = wp.zeros((n, n_channels, bins * bins), dtype=wp.float32, device=device)
        block_counts = wp.zeros((n, bins * bins), dtype=wp.int32, device=device)
        inputs = [views, grid, directions, attributes]
        wp.launch(bin_kernel, n, inputs, [block_means, block_counts], device=device)
        means[rows] = block_means.numpy().reshape(-1, n_channels, bins, bins)
        counts[rows] = block_counts.numpy().reshape(-1, bins, bins)
    return BinnedViews(means, counts, channels)


def count_bins(
    posed: PosedViews, bins: int = 30, device: str = "cpu", block_bytes: int = 1 << 30
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """`n_visible` and `n_filled`, (B,) each, of what `bin_views` makes, which is the plain twin of this."""
    if isinstance(posed.camera, ColmapCamera):
        binned = bin_views_plain(posed, bins)
        return binned.n_visible, binned.n_filled
    device = start_warp(device)
    lanes = GPU_LANES if device != "cpu" else 1
    n_in_view, n_filled = (np.empty(len(posed.cam_from_world), dtype=np.int32) for _ in range(2))
    block = max(1, block_bytes // (bins * bins * 4))
    for rows, views, grid in _blocks(posed, bins, device, block):
        n = rows.stop - rows.start
        taken = wp.zeros((n, bins * bins), dtype=wp.int32, device=device)
        outputs = [wp.zeros(n, dtype=wp.int32, device=device) for _ in range(2)]
        wp.launch(count_bins_kernel, (n, lanes), [views, grid, lanes, taken], outputs, device=device)
        n_in_view[rows], n_filled[rows] = (numbers.numpy() for numbers in outputs)
    return n_in_view, n_filled


def _blocks(posed: PosedViews, bins: int, device: str, block: int) -> Iterator[tuple[slice, Any, Any]]:
    """Up to `block` views at a time: which of the views, and `Views` and `BinGrid` of them on the device."""
    camera = posed.camera
    poses = np.asarray(posed.cam_from_world)
    assert isinstance(camera, PinholeCamera)
    landmarks = frustum.points_on_device(posed.points, device)
    sets = frustum.sets_on_device(posed.unoccluded, device)
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
    """What `bin_views` computes, in NumPy."""
    camera = posed.camera
    channels = CHANNELS if landmarks is None else ALL_CHANNELS
    attributes = None if landmarks is None else landmarks.attributes()
    n_views = len(posed.cam_from_world)
    n_cells = bins * bins
    means = np.zeros((n_views, len(channels), n_cells), dtype=np.float32)
    counts = np.zeros((n_views, n_cells), dtype=np.int32)
    rows = zip(*split_poses(posed.cam_from_world), posed.location_rows, strict=True)
    for view, (rotation, center, location) in enumerate(rows):
        candidates = posed.unoccluded[int(location)]
        offsets = frustum.offsets_from(center, posed.points[candidates])
        seen = frustum.in_view(camera, rotation[None], offsets)[0]
        offsets = offsets[seen]
        seen_rows = candidates[seen]
        points_cam = frustum.rotate(rotation.astype(np.float32), offsets)
        pixels = frustum.pixels_of(camera, points_cam)
        scale = np.array([bins / camera.width, bins / camera.height])
        column, row = np.clip((pixels * scale).astype(int), 0, bins - 1).T
        cell = row * bins + column
        counts[view] = np.bincount(cell, minlength=n_cells)
        columns = [*pixels.T, *points_cam.T]
        if landmarks is not None and attributes is not None:
            distance = np.linalg.norm(offsets.astype(np.float64), axis=1)
            along = (offsets.astype(np.float64) * landmarks.mapping_direction[seen_rows]).sum(1)
            of_map = attributes[seen_rows]
            ratio = np.log(distance) - of_map[:, MAP_ATTRIBUTES.index("mapped_distance")]
            columns += [along / distance, ratio, *of_map.T]
        for channel, values in enumerate(columns):
            means[view, channel] = np.bincount(cell, weights=values, minlength=n_cells) / np.maximum(counts[view], 1)
    return BinnedViews(means.reshape(n_views, -1, bins, bins), counts.reshape(n_views, bins, bins), channels)
