"""Where a camera can be by depth images alone: clear of the surface they fuse to, in space that they saw through."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates
from tqdm.auto import tqdm

from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.poses import Float
from wheretolook.space.free_space import FreeSpace, FreeSpaceConfig
from wheretolook.visibility.tsdf import DepthImage, TsdfVolume

CELL_M = 0.05
"""Side of the cells of space that was seen or was not; half the clearance if that is less, but a voxel at least."""


class TsdfSpace(FreeSpace):
    """Free space of a truncated signed distance field.

    The field itself knows no more than a few voxels on either side of a surface, so what is empty and what was never
    seen is told by the depth images. Space that none of them saw through may hold anything: like a surface, it must be
    farther than the clearance. In the rest, the surface counts as a mesh does in `FreeSpace`; its fronts face the
    cameras that saw it, so the inside of what is closed is not free.

    Args:
        volume: the fused depth images; not needed any more afterwards.
        images: the same images, looked at once more.
        config: what counts as free; the surface is one-sided, whatever it says.
        device: "cpu" or a CUDA device.
        progress: show a progress bar.

    Attributes:
        cells: of the space within the bounds.
        to_unseen_m: (nx, ny, nz) float32, distance from the centre of each cell to the nearest centre that no image saw
            through.

    Raises:
        SceneError: the depth images show no surface.
        ConfigError: if there is no such device.
    """

    def __init__(
        self, volume: TsdfVolume, images: Sequence[DepthImage], config: FreeSpaceConfig | None = None,
        device: str = "cpu", progress: bool = True,
    ) -> None:  # fmt: skip
        super().__init__(volume.surface(), replace(config or FreeSpaceConfig(), two_sided=False), device)
        self._step_m = volume.config.voxel_size_m
        cell_m = max(self._step_m, min(CELL_M, self.config.clearance_m / 2))
        nx, ny, nz = np.maximum(np.ceil((self.bounds[1] - self.bounds[0]) / cell_m), 1).astype(int).tolist()
        self.cells = VoxelGrid.over(self.bounds, (nx, ny, nz))
        seen = seen_through(self.cells.centers(), images, volume.config.max_depth_m, progress)
        around = np.pad(seen.reshape(nx, ny, nz), 1)  # beyond the bounds nothing was seen
        to_unseen_m = distance_transform_edt(around, sampling=self.cells.voxel_m)[1:-1, 1:-1, 1:-1]
        self.to_unseen_m = to_unseen_m.astype(np.float32)

    def is_free(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether a camera can be at points (N, 3) metres: as in `FreeSpace`, off what was not seen; (N,)."""
        at = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        free = self._is_known_at(at)
        free[free] = super().is_free(at[free])
        return free

    def segments_are_free(self, a: ArrayLike, b: ArrayLike) -> NDArray[np.bool_]:
        """Whether a camera can move straight from a (N, 3) to b (N, 3) metres.

        As in `FreeSpace`, and all of the way must be off what was not seen, looked at no more than a voxel apart.

        Returns:
            (N,) bool.
        """
        start, end = (np.asarray(points, dtype=np.float64).reshape(-1, 3) for points in (a, b))
        free = super().segments_are_free(start, end)
        rows = np.flatnonzero(free)
        length = np.linalg.norm(end[rows] - start[rows], axis=1)
        steps = np.ceil(length / self._step_m).astype(np.int64) + 1
        first = np.cumsum(steps) - steps
        of = np.repeat(np.arange(len(rows)), steps)
        share = (np.arange(len(of)) - first[of]) / np.maximum(steps[of] - 1, 1)
        between = start[rows[of]] + share[:, None] * (end[rows[of]] - start[rows[of]])
        free[rows[of[~self._is_known_at(between)]]] = False
        return free

    def _is_known_at(self, points: Float) -> NDArray[np.bool_]:
        """Whether the nearest place that may be occupied unseen is as far as the clearance.

        It lies up to a cell before an unseen centre, half a cell on average.
        """
        size = self.cells.voxel_m
        at = (points - self.cells.lower) / size - 0.5
        distance = map_coordinates(self.to_unseen_m, at.T, order=1, mode="nearest")
        inside = ((points >= self.bounds[0]) & (points <= self.bounds[1])).all(axis=1)
        return np.asarray(inside & (distance >= self.config.clearance_m + size.max() / 2))


def seen_through(
    points: Float, images: Sequence[DepthImage], max_depth_m: float, progress: bool = True
) -> NDArray[np.bool_]:
    """Whether at least one depth image saw something behind each of points (N, 3) m; (N,).

    Args:
        points: in the world.
        images: read one after the other.
        max_depth_m: farther readings are left out.
        progress: show a progress bar.
    """
    seen = np.zeros(len(points), dtype=bool)
    for index in tqdm(range(len(images)), desc="seen space", unit="image", disable=not progress):
        image = images[index]
        depth, rows = image.readings(max_depth_m), np.flatnonzero(~seen)
        pose = np.asarray(image.cam_from_world, dtype=np.float64)
        in_camera = points[rows] @ pose[:, :3].T + pose[:, 3]
        before = in_camera[:, 2] > 0
        rows, in_camera = rows[before], in_camera[before]
        pixels = np.floor((in_camera @ image.camera.matrix.T)[:, :2] / in_camera[:, 2:])
        inside = ((pixels >= 0) & (pixels < (image.camera.width, image.camera.height))).all(axis=1)
        column, row = pixels[inside].astype(np.int64).T
        seen[rows[inside]] = in_camera[inside, 2] < depth[row, column]
    return seen
