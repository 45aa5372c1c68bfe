"""Where a camera can be according to depth images: clear of their fused surface, in space that they saw through."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates
from tqdm.auto import tqdm

from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.poses import Float
from wheretolook.geometry.tsdf import DepthImages, TsdfVolume
from wheretolook.space.config import FreeSpaceConfig
from wheretolook.space.free_space import FreeSpace

CELL_M = 0.05
"""Side of the cells that were seen through or not; half the clearance if that is less, but at least a voxel."""


class TsdfSpace(FreeSpace):
    """Free space of a truncated signed distance field.

    The field covers only a few voxels on either side of a surface, so the depth images themselves separate empty from
    unobserved space. Space that none of them saw through may contain anything: like a surface, it must be
    farther away than the clearance. Elsewhere the surface counts as a mesh does in `FreeSpace`; its fronts face the
    cameras that saw it, so the inside of closed objects is not free.

    The volume is of the same images and not needed any more afterwards; `two_sided` is ignored, since the surface is
    one-sided. `cells` is a grid over the bounds; `to_unseen_m` (nx, ny, nz) is the distance from each one's centre
    to the nearest centre of a cell that no image saw through. Raises SceneError if the depth images show no surface,
    ConfigError if there is no such device.
    """

    def __init__(
        self,
        volume: TsdfVolume,
        images: DepthImages,
        config: FreeSpaceConfig = FreeSpaceConfig(),
        device: str = "cpu",
        progress: bool = True,
    ) -> None:
        super().__init__(volume.surface(), replace(config, two_sided=False), device)
        self._step_m = volume.config.voxel_size_m
        cell_m = max(self._step_m, min(CELL_M, self.config.clearance_m / 2))
        nx, ny, nz = np.maximum(np.ceil((self.bounds[1] - self.bounds[0]) / cell_m), 1).astype(int).tolist()
        self.cells = VoxelGrid.over(self.bounds, (nx, ny, nz))
        seen = seen_through(self.cells.centers(), images, volume.config.max_depth_m, progress)
        padded = np.pad(seen.reshape(nx, ny, nz), 1)  # space beyond the bounds counts as unseen
        to_unseen_m = distance_transform_edt(padded, sampling=self.cells.voxel_m)[1:-1, 1:-1, 1:-1]
        self.to_unseen_m = to_unseen_m.astype(np.float32)

    def is_free(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether a camera can be at points (N, 3) metres: as in `FreeSpace`, and clear of unseen space; (N,)."""
        at = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        free = self._is_off_unseen(at)
        free[free] = super().is_free(at[free])
        return free

    def segments_are_free(self, a: ArrayLike, b: ArrayLike) -> NDArray[np.bool_]:
        """Whether a camera can move straight from a (N, 3) to b (N, 3) metres; (N,).

        As in `FreeSpace`, and all of the segment must be clear of unseen space (tested at most a voxel apart).
        """
        start, end = (np.asarray(points, dtype=np.float64).reshape(-1, 3) for points in (a, b))
        free = super().segments_are_free(start, end)
        rows = np.flatnonzero(free)
        length = np.linalg.norm(end[rows] - start[rows], axis=1)
        steps = np.ceil(length / self._step_m).astype(np.int64) + 1
        first = np.cumsum(steps) - steps
        segment = np.repeat(np.arange(len(rows)), steps)
        share = (np.arange(len(segment)) - first[segment]) / np.maximum(steps[segment] - 1, 1)
        between = start[rows[segment]] + share[:, None] * (end[rows[segment]] - start[rows[segment]])
        free[rows[segment[~self._is_off_unseen(between)]]] = False
        return free

    def _is_off_unseen(self, points: Float) -> NDArray[np.bool_]:
        """Whether points (N, 3) are within the bounds and as far as the clearance from unseen space; (N,).

        Unseen space begins up to a cell before an unseen cell's centre, half a cell on average.
        """
        size = self.cells.voxel_m
        at = (points - self.cells.lower) / size - 0.5
        distance = map_coordinates(self.to_unseen_m, at.T, order=1, mode="nearest")
        inside = ((points >= self.bounds[0]) & (points <= self.bounds[1])).all(axis=1)
        return np.asarray(inside & (distance >= self.config.clearance_m + size.max() / 2))


def seen_through(points: Float, images: DepthImages, max_depth_m: float, progress: bool = True) -> NDArray[np.bool_]:
    """Whether a depth image saw something behind points (N, 3) m, but for readings beyond `max_depth_m`; (N,)."""
    seen = np.zeros(len(points), dtype=bool)
    for index in tqdm(range(len(images)), desc="seen space", unit="image", disable=not progress):
        image = images[index]
        depth = image.readings(max_depth_m)
        rows = np.flatnonzero(~seen)
        pose = np.asarray(image.cam_from_world, dtype=np.float64)
        in_camera = points[rows] @ pose[:, :3].T + pose[:, 3]
        in_front = in_camera[:, 2] > 0
        rows = rows[in_front]
        in_camera = in_camera[in_front]
        pixels = np.floor((in_camera @ image.camera.matrix.T)[:, :2] / in_camera[:, 2:])
        inside = ((pixels >= 0) & (pixels < (image.camera.width, image.camera.height))).all(axis=1)
        column, row = pixels[inside].astype(np.int64).T
        seen[rows[inside]] = in_camera[inside, 2] < depth[row, column]
    return seen
