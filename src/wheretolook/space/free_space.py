"""Where a camera can be: clear of geometry, above a floor, inside the building; without a mesh near mapping cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates
from tqdm.auto import tqdm

from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import Float, as_points
from wheretolook.geometry.tsdf import DepthImages, TsdfVolume
from wheretolook.rendering.raycasting import MeshRaycaster, RayHits
from wheretolook.space.config import FreeSpaceConfig


class FreeSpace:
    """Tests locations and straight paths in a scene with a mesh, z up. Raises ConfigError if there is no such device.

    `bounds` (2, 3) are its lowest and highest corner in metres, `two_sided` says whether both sides of a triangle count
    as a surface, and `raycaster` has the mesh, for rays and distances.
    """

    def __init__(self, mesh: TexturedMesh, config: FreeSpaceConfig = FreeSpaceConfig(), device: str = "cpu") -> None:
        self.config = config
        self.bounds = mesh.bounds
        self.raycaster = MeshRaycaster(mesh, device)
        normals = mesh.normals
        length = np.linalg.norm(normals, axis=1)
        self._level = np.abs(normals[:, 2]) > 0.5 * np.where(length > 0, length, np.inf)
        self.two_sided = self.config.two_sided is not False
        if self.config.two_sided is None:
            self.two_sided = not self._sees_fronts()

    def is_free(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether a camera can be at points (N, 3) metres; (N,).

        A point is free if it is within the bounds, no geometry is closer than `clearance_m`, the first surface
        straight below is level (within 60 degrees) and at most `max_floor_drop_m` away, and the point is enclosed, as
        `FreeSpaceConfig` says.
        """
        at = as_points(points)
        free = ((at >= self.bounds[0]) & (at <= self.bounds[1])).all(axis=1)  # the cheap tests first
        clearance_m = self.config.clearance_m
        free[free] = self.raycaster.distance_to_surface(at[free], clearance_m) >= clearance_m
        free[free] = np.isfinite(self.floor_below(at[free]))
        free[free] = self._is_enclosed(at[free])
        return free

    def segments_are_free(self, a: ArrayLike, b: ArrayLike) -> NDArray[np.bool_]:
        """Whether a camera can move straight from a (N, 3) to b (N, 3) metres; (N,).

        Both ends must be free and every point between must keep the clearance; it need not be above a floor.
        """
        start = as_points(a)
        end = as_points(b)
        free = self.is_free(start) & self.is_free(end)
        free[free] = self.raycaster.segments_are_clear(start[free], end[free], self.config.clearance_m)
        return free

    def floor_below(self, points: ArrayLike) -> NDArray[np.float64]:
        """Height z (N,) of the floor below points (N, 3) metres; NaN where `is_free` would find none."""
        at = as_points(points)
        hits = self.raycaster.cast(at, (0.0, 0.0, -1.0))
        near = hits.distance_m <= self.config.max_floor_drop_m
        is_floor = near & self._level[hits.triangle] & (hits.front | self.two_sided)
        return np.where(is_floor, at[:, 2] - hits.distance_m, np.nan)

    def _is_enclosed(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        step = 1 << 18  # the 34 rays of a point take about 2 KB
        if len(points) > step:
            parts = [self._is_enclosed(points[start : start + step]) for start in range(0, len(points), step)]
            return np.concatenate(parts)
        hits = self._cast_sphere(points)
        surface = np.isfinite(hits.distance_m) & (hits.front | self.two_sided)
        enclosed: NDArray[np.bool_] = surface.mean(axis=1) >= self.config.min_enclosure
        if self.two_sided:
            enclosed &= np.mean(hits.distance_m[:, :16] >= self.config.min_sight_m, axis=1) >= 0.25
        return enclosed

    def _cast_sphere(self, points: NDArray[np.float64]) -> RayHits:
        """Hits (N, 34) of rays in all directions; the 16 level ones come first."""
        directions = _sphere_directions()
        shape = (len(points), len(directions))
        hits = self.raycaster.cast(np.repeat(points, shape[1], axis=0), np.tile(directions, (shape[0], 1)))
        return RayHits(hits.distance_m.reshape(shape), hits.triangle.reshape(shape), hits.front.reshape(shape))

    def _sees_fronts(self) -> bool:
        """Whether most of the points that are free in a two-sided scene see mostly fronts."""
        low, high = self.bounds
        points = np.random.default_rng(0).uniform(low, high, size=(1024, 3))
        hits = self._cast_sphere(points[self.is_free(points)])
        hit = np.isfinite(hits.distance_m)
        if not hit.any():
            return False
        front_share = hits.front.sum(axis=1) / np.maximum(hit.sum(axis=1), 1)
        return bool(np.mean(front_share > 0.8) > 0.5)


def _sphere_directions() -> NDArray[np.float64]:
    """Unit directions (34, 3): 16 level, 8 rising and 8 falling by 45 degrees, up, down."""
    rings = []
    for count, elevation in ((16, 0.0), (8, np.pi / 4), (8, -np.pi / 4)):
        azimuth = np.arange(count) * 2 * np.pi / count
        level = np.cos(elevation)
        ring = [np.cos(azimuth) * level, np.sin(azimuth) * level, np.full(count, np.sin(elevation))]
        rings.append(np.stack(ring, axis=1))
    return np.concatenate([*rings, [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]])


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
        self._step_m = volume.voxel_size_m
        cell_m = max(self._step_m, min(0.05, self.config.clearance_m / 2))
        nx, ny, nz = np.maximum(np.ceil((self.bounds[1] - self.bounds[0]) / cell_m), 1).astype(int).tolist()
        self.cells = VoxelGrid.over(self.bounds, (nx, ny, nz))
        seen = seen_through(self.cells.centers(), images, volume.max_depth_m, progress)
        padded = np.pad(seen.reshape(nx, ny, nz), 1)  # space beyond the bounds counts as unseen
        to_unseen_m = distance_transform_edt(padded, sampling=self.cells.voxel_m)[1:-1, 1:-1, 1:-1]
        self.to_unseen_m = to_unseen_m.astype(np.float32)

    def is_free(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether a camera can be at points (N, 3) metres: as in `FreeSpace`, and clear of unseen space; (N,)."""
        at = as_points(points)
        free = self._is_off_unseen(at)
        free[free] = super().is_free(at[free])
        return free

    def segments_are_free(self, a: ArrayLike, b: ArrayLike) -> NDArray[np.bool_]:
        """Whether a camera can move straight from a (N, 3) to b (N, 3) metres; (N,).

        As in `FreeSpace`, and all of the segment must be clear of unseen space (tested at most a voxel apart).
        """
        start = as_points(a)
        end = as_points(b)
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
