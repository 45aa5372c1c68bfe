"""Candidate viewpoints: a voxel grid of locations and lattices of viewing directions (paper, Sec. 3.1)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.poses import Float
from wheretolook.utils.devices import fitting
from wheretolook.utils.errors import ConfigError, check_choice

GOLDEN_ANGLE = np.pi * (1 + np.sqrt(5))  # radians between neighbours of the spiral: the paper's i * pi * (1 + sqrt 5)
Lattice = Literal["fibonacci", "azimuth-elevation", "released", "yaw-pitch"]


@dataclass(frozen=True)
class VoxelGrid:
    """A box cut into equal cuboids; a voxel's centre is a location (paper, Sec. 3.1 "Location").

    A location's id is its position in row-major (x, y, z) order, so id and centre follow from each other by arithmetic.
    """

    lower: tuple[float, float, float]  # lowest corner (x, y, z) in metres
    upper: tuple[float, float, float]  # highest corner
    shape: tuple[int, int, int] = (8, 8, 8)  # number of voxels along x, y and z

    def __post_init__(self) -> None:
        if min(self.shape) < 1:
            raise ConfigError("a grid needs at least one voxel along every axis", value=self.shape)
        if not (self.voxel_m > 0).all() or not np.isfinite([self.lower, self.upper]).all():
            raise ConfigError("grid bounds must be finite and lower < upper", value=(self.lower, self.upper))

    @classmethod
    def over(cls, bounds: ArrayLike, shape: tuple[int, int, int] = (8, 8, 8)) -> VoxelGrid:
        """A grid over bounds (2, 3): lowest and highest corner in metres."""
        (x0, y0, z0), (x1, y1, z1) = np.asarray(bounds, dtype=np.float64).tolist()
        return cls((x0, y0, z0), (x1, y1, z1), shape)

    def __len__(self) -> int:
        return math.prod(self.shape)

    @property
    def voxel_m(self) -> Float:
        """Edge lengths of a voxel, (3,) metres."""
        return (np.asarray(self.upper) - self.lower) / self.shape

    def centers(self) -> Float:
        """All locations in the order of their ids, (len(self), 3) metres. ConfigError if memory does not hold them."""
        check_voxels(self.shape)
        index = np.stack(np.unravel_index(np.arange(len(self)), self.shape), axis=-1)
        return np.asarray(self.lower) + (index + 0.5) * self.voxel_m

    def location_ids(self, points: ArrayLike) -> NDArray[np.int64]:
        """Ids of the voxels that hold world points (..., 3) m; -1 outside the grid (and NaN). Its bounds are inside."""
        points = np.asarray(points, dtype=np.float64)
        inside = np.all((points >= self.lower) & (points <= self.upper), axis=-1)
        scaled = np.where(inside[..., None], (points - self.lower) / self.voxel_m, 0.0)
        index = np.minimum(scaled.astype(np.int64), np.asarray(self.shape) - 1)
        _, ny, nz = self.shape
        return np.where(inside, (index[..., 0] * ny + index[..., 1]) * nz + index[..., 2], -1)


def check_voxels(shape: tuple[int, int, int]) -> None:
    """Raise ConfigError if memory does not hold the locations of a grid."""
    if min(shape) < 1:
        raise ConfigError("a grid needs at least one voxel along every axis", value=shape)
    voxels = math.prod(shape)
    # a voxel takes 160 bytes while its location and whether it is free are computed; tables hold ids in 32 bits
    most = min(fitting(160), 2**31 - 1)
    if voxels <= most:
        return
    fix = f"There is room for {most:,} voxels."
    raise ConfigError(f"a grid of {voxels:,} voxels is too large", value=shape, fix=fix)


@dataclass(frozen=True)
class ViewLattice:
    """Candidate views of a scene: a grid of locations with the same directions at each of them.

    Args:
        grid: voxels along x, y and z over the scene's bounds.
        directions: directions at each location.
        lattice: how directions are spread: fibonacci, azimuth-elevation, released or yaw-pitch. The first is even, the
            second the paper's comparison, the third what the released code does, and "yaw-pitch" are ActLoc's 6 pitches
            x 18 yaws, whatever `directions` says.

    Raises:
        ConfigError: no voxel, more voxels than fit into memory, no direction, or no such lattice.
    """

    grid: tuple[int, int, int] = (8, 8, 8)
    directions: int = 500
    lattice: Lattice = "fibonacci"

    def __post_init__(self) -> None:
        check_voxels(self.grid)
        _positive(self.directions)
        check_choice("lattice", self.lattice, LATTICES)

    def voxels(self, bounds: ArrayLike) -> VoxelGrid:
        """The grid over a scene's bounds (2, 3): lowest and highest corner in metres."""
        return VoxelGrid.over(bounds, self.grid)

    def axes(self) -> Float:
        """The directions, (D, 3) unit vectors in the world."""
        return direction_lattice(self.directions, self.lattice)


def spread_rows(n: int, max_count: int) -> NDArray[np.int64]:
    """Return at most so many evenly spread rows of n."""
    return np.unique(np.linspace(0, n - 1, min(max_count, n)).round().astype(int))


def fibonacci_sphere(n: int) -> Float:
    """Spherical Fibonacci lattice: n unit vectors (n, 3), from +z to -z, spread almost evenly (González 2010).

    z_i = 1 - (2 i + 1) / n and azimuth_i = i * pi * (1 + sqrt 5), i = 0 .. n-1.

    The paper (Eq. 2) prints arccos((1 - 2 i) / N), which is undefined for half of its indices. The released code has
    the right arccos but takes it for the azimuth and the golden angle for the polar angle (`released_lattice`), so that
    its directions crowd at two poles: at n = 500 the direction farthest from all of them is 20.4 degrees away, against
    7.0 degrees here (exact covering radii).
    """
    index = np.arange(_positive(n))
    z = 1 - (2 * index + 1) / n
    radius = np.sqrt(1 - z * z)
    azimuth = GOLDEN_ANGLE * index
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)


def azimuth_elevation_lattice(n: int) -> Float:
    """Equal steps of azimuth and elevation, the paper's comparison: unit vectors (m, 3), crowded at the poles.

    There are about sqrt(n / 2) rows of constant elevation, none on a pole, with about twice as many azimuths in each,
    so that the steps are nearly equal; m is the product of rows and azimuths. From +z to -z.
    """
    rows = max(1, round(np.sqrt(_positive(n) / 2)))
    columns = max(1, round(n / rows))
    polars = (np.arange(rows) + 0.5) * np.pi / rows
    azimuths = np.arange(columns) * 2 * np.pi / columns
    polar, azimuth = (angle.ravel() for angle in np.meshgrid(polars, azimuths, indexing="ij"))
    return np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)


def released_lattice(n: int) -> Float:
    """The optical axes (n, 3) of the paper's released code, kept to show the difference.

    R = Rz(azimuth) Rx(elevation), azimuth = arccos(1 - 2 (i + 0.5) / n), elevation = (i + 0.5) * pi * (1 + sqrt 5).
    """
    index = np.arange(_positive(n)) + 0.5
    azimuth = np.arccos(1 - 2 * index / n)
    elevation = GOLDEN_ANGLE * index
    sine = np.sin(elevation)
    return np.stack([np.sin(azimuth) * sine, -np.cos(azimuth) * sine, np.cos(elevation)], axis=-1)


def yaw_pitch_angles() -> Float:
    """ActLoc's 6 pitches from -60 to 40 and 18 yaws from -180 to 160, 20 apart: (108, 2) degrees, (yaw, pitch)."""
    pitch, yaw = np.meshgrid(np.arange(-60, 60, 20), np.arange(-180, 180, 20), indexing="ij")
    return np.stack([yaw, pitch], axis=-1).reshape(-1, 2).astype(np.float64)


def axes_of_angles(yaw_pitch_deg: ArrayLike) -> Float:
    """Unit directions (..., 3) of yaws, counter-clockwise from +x, and pitches, up from level, (..., 2) degrees."""
    yaw, pitch = np.moveaxis(np.radians(np.asarray(yaw_pitch_deg, dtype=np.float64)), -1, 0)
    return np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)], axis=-1)


def direction_lattice(n: int, lattice: Lattice = "fibonacci") -> Float:
    """Directions (m, 3) of the named lattice; m = n but for "azimuth-elevation" (near n) and "yaw-pitch" (108)."""
    check_choice("lattice", lattice, LATTICES)
    return LATTICES[lattice](n)


LATTICES: dict[str, Callable[[int], Float]] = {
    "fibonacci": fibonacci_sphere,
    "azimuth-elevation": azimuth_elevation_lattice,
    "released": released_lattice,
    "yaw-pitch": lambda n: axes_of_angles(yaw_pitch_angles()),
}


def _positive(n: int) -> int:
    if n < 1:
        raise ConfigError("a lattice needs at least one direction", value=n)
    if n > (most := fitting(500)):  # bytes of a direction while rotations and views are made of it
        fix = f"There is room for {most:,}."
        raise ConfigError("so many directions do not fit into memory", value=n, fix=fix)
    return n
