"""Where a camera can be in a scene: clear of geometry, above a floor, inside the building."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.rendering.raycasting import MeshRaycaster, RayHits
from wheretolook.utils.errors import ConfigError

_N_AUTO_POINTS = 1024  # sampled to find out whether triangles are wound reliably


@dataclass(frozen=True)
class FreeSpaceConfig:
    """What counts as free.

    Args:
        clearance_m: least distance to any geometry.
        max_floor_drop_m: greatest height above the surface straight below, which must be roughly level.
        min_enclosure: least share of 34 rays around a point (16 level, 8 rising and 8 falling by 45 degrees, up and
            down) that meet a surface. A point in a room without a ceiling reaches 25 / 34 = 0.74; one outside a wall
            or above a ceiling stays below 19 / 34 = 0.56, since at least half of its level rays and all rising ones
            leave the scene. Windows, doors and holes of a scan let some rays out.
        two_sided: whether triangles are surfaces from both sides. If not, only fronts count as floor and as enclosure,
            so that a point inside a solid or outside a shell of one layer is never free. None finds out: triangles are
            taken as one-sided if most points that would be free in a two-sided scene see mostly fronts.
        min_sight_m: in a two-sided scene, where the inside of closed furniture looks like a room, at least a quarter of
            the level rays must be this long; 1 m leaves corridors of 0.8 m free and closets of 0.7 m not.
    """

    clearance_m: float = 0.25
    max_floor_drop_m: float = 4.0
    min_enclosure: float = 0.6
    two_sided: bool | None = None
    min_sight_m: float = 1.0

    def __post_init__(self) -> None:
        if not self.clearance_m > 0 or not self.max_floor_drop_m > 0 or self.min_sight_m < 0:
            raise ConfigError(
                "clearance and floor drop must be positive, sight not negative",
                value=(self.clearance_m, self.max_floor_drop_m, self.min_sight_m),
            )
        if not 0 <= self.min_enclosure <= 1:
            raise ConfigError("min_enclosure is a share between 0 and 1", value=self.min_enclosure)


class FreeSpace:
    """Tests locations and straight paths in a scene.

    Args:
        mesh: the scene, z up.
        config: what counts as free.
        device: "cpu" or a CUDA device.

    Attributes:
        bounds: (2, 3) metres, lowest and highest corner of the scene.
        two_sided: whether both sides of a triangle count as a surface, as configured or found out.

    Raises:
        ConfigError: if there is no such device.
    """

    def __init__(self, mesh: TexturedMesh, config: FreeSpaceConfig | None = None, device: str = "cpu") -> None:
        self.config = config or FreeSpaceConfig()
        self.bounds = mesh.bounds
        self._raycaster = MeshRaycaster(mesh, device)
        corners = mesh.vertices[mesh.triangles].astype(np.float64)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normals, axis=1)
        self._level = np.abs(normals[:, 2]) > 0.5 * np.where(length > 0, length, np.inf)
        self.two_sided = True if self.config.two_sided is None else self.config.two_sided
        if self.config.two_sided is None:
            self.two_sided = not self._sees_fronts()

    def is_free(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether a camera can be at points (N, 3) metres.

        A point is free if it lies within the bounds, no geometry is closer than `clearance_m`, the first surface
        straight below is level (within 60 degrees) and at most `max_floor_drop_m` away, and the point is enclosed, as
        `FreeSpaceConfig` says.

        Returns:
            (N,) bool.
        """
        at = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        free = ((at >= self.bounds[0]) & (at <= self.bounds[1])).all(axis=1)
        for test in (self._is_clear, self._is_above_floor, self._is_enclosed):  # the cheap ones first
            free[free] = test(at[free])
        return free

    def segments_are_free(self, a: ArrayLike, b: ArrayLike) -> NDArray[np.bool_]:
        """Whether a camera can move straight from a (N, 3) to b (N, 3) metres.

        Both ends must be free and every point between keep the clearance; what is below the way does not matter.

        Returns:
            (N,) bool.
        """
        start, end = (np.asarray(points, dtype=np.float64).reshape(-1, 3) for points in (a, b))
        free = self.is_free(start) & self.is_free(end)
        free[free] = self._raycaster.segments_are_clear(start[free], end[free], self.config.clearance_m)
        return free

    def floor_below(self, points: ArrayLike) -> NDArray[np.float64]:
        """Height z (N,) of the floor below points (N, 3) metres; NaN where `is_free` would find none."""
        at = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        hits = self._raycaster.cast(at, np.broadcast_to((0.0, 0.0, -1.0), at.shape))
        return np.where(self._is_floor(hits), at[:, 2] - hits.distance_m, np.nan)

    def _is_clear(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        return self._raycaster.distance_to_surface(points, self.config.clearance_m) >= self.config.clearance_m

    def _is_above_floor(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.isfinite(self.floor_below(points))

    def _is_floor(self, hits: RayHits) -> NDArray[np.bool_]:
        near = hits.distance_m <= self.config.max_floor_drop_m
        return near & self._level[hits.triangle] & (hits.front | self.two_sided)

    def _is_enclosed(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        hits = self._look_around(points)
        surface = np.isfinite(hits.distance_m) & (hits.front | self.two_sided)
        enclosed: NDArray[np.bool_] = surface.mean(axis=1) >= self.config.min_enclosure
        if self.two_sided:
            enclosed &= np.mean(hits.distance_m[:, :16] >= self.config.min_sight_m, axis=1) >= 0.25
        return enclosed

    def _look_around(self, points: NDArray[np.float64]) -> RayHits:
        """Hits (N, 34) of the rays that tell whether a point is enclosed; the 16 level ones come first."""
        directions = _around()
        hits = self._raycaster.cast(np.repeat(points, len(directions), axis=0), np.tile(directions, (len(points), 1)))
        shape = (len(points), len(directions))
        return RayHits(hits.distance_m.reshape(shape), hits.triangle.reshape(shape), hits.front.reshape(shape))

    def _sees_fronts(self) -> bool:
        """Whether most of the points that are free in a two-sided scene see mostly fronts."""
        low, high = self.bounds
        points = np.random.default_rng(0).uniform(low, high, size=(_N_AUTO_POINTS, 3))
        hits = self._look_around(points[self.is_free(points)])
        hit = np.isfinite(hits.distance_m)
        if not hit.any():
            return False
        front_share = hits.front.sum(axis=1) / np.maximum(hit.sum(axis=1), 1)
        return bool(np.mean(front_share > 0.8) > 0.5)


def _around() -> NDArray[np.float64]:
    """Unit directions (34, 3): 16 level, 8 rising and 8 falling by 45 degrees, up, down."""
    rings = []
    for count, elevation_deg in ((16, 0.0), (8, 45.0), (8, -45.0)):
        azimuth, elevation = np.arange(count) * 2 * np.pi / count, np.radians(elevation_deg)
        level = np.cos(elevation)
        rings.append(
            np.stack([np.cos(azimuth) * level, np.sin(azimuth) * level, np.full(count, np.sin(elevation))], axis=1)
        )
    return np.concatenate([*rings, [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]])
