"""Where a camera can be, and the views that a robot will have there."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from wheretolook.extend.config import TargetOptions
from wheretolook.extend.surface import mapping_views
from wheretolook.geometry.camera import Camera, field_of_view_deg
from wheretolook.geometry.lattices import axes_of_angles
from wheretolook.geometry.poses import Float, camera_centers, poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.space.free_space import FreeSpace
from wheretolook.utils.errors import ConfigError, SceneError


def camera_places(space: Any, cameras: Float, height_m: float | None, most: int) -> tuple[Float, float]:
    """Return at most about `most` places (W, 3) m where a camera can be, and how far they are apart.

    Above a floor of a `FreeSpace` they are at a height, by default the median one of the mapping cameras (M, 3), and
    reachable in free space from the cameras. In a `MappedSpace`, without a floor, they are at the height of the nearest camera.
    Raises SceneError if there is no place.
    """
    low, high = np.asarray(space.bounds, dtype=np.float64)
    step = max(0.25, float(np.sqrt(np.prod(high[:2] - low[:2]) / 40_000)))
    x, y = (np.arange(low[axis] + step / 2, high[axis], step) for axis in (0, 1))
    ground = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    if isinstance(space, FreeSpace):
        if height_m is None:
            heights = cameras[:, 2] - space.floor_below(cameras)
            height_m = float(np.median(heights[np.isfinite(heights)])) if np.isfinite(heights).any() else 1.5
        places = _above_floors(space, ground, height_m)
        places = _reached(space, places, cameras, step)
    else:
        nearest = cKDTree(cameras[:, :2]).query(ground)[1]
        places = np.column_stack([ground, cameras[nearest, 2]])
        places = places[space.is_free(places)]
    if len(places) == 0:
        value = f"height {height_m:g} m" if height_m is not None else f"{len(ground)} places tried"
        fix = "Check --height, --mesh-up and the scale."
        raise SceneError("there is no place where a camera can be", value=value, fix=fix)
    apart = max(0.5, step * float(np.sqrt(len(places) / most)))
    cell = np.floor(places / (apart, apart, 1.0)).astype(np.int64)
    off = np.linalg.norm(places[:, :2] / apart - cell[:, :2] - 0.5, axis=1)
    order = np.argsort(off, kind="stable")
    first = np.unique(cell[order], axis=0, return_index=True)[1]
    return places[order[first]], apart


def _above_floors(space: FreeSpace, ground: Float, height_m: float) -> Float:
    """Return the free places (N, 3) at a height above the floors of all storeys."""
    low, high = space.bounds[:, 2]
    probes = [np.column_stack([ground, np.full(len(ground), z)]) for z in np.arange(low + 0.3, high, 1.0)]
    at = np.concatenate(probes)
    at[:, 2] = np.round(space.floor_below(at), 2) + height_m
    at = np.unique(at[np.isfinite(at[:, 2])], axis=0)
    at = at[space.is_free(at)]
    return at[np.abs(at[:, 2] - space.floor_below(at) - height_m) < 0.05]  # no table between the floor and the camera


def _reached(space: FreeSpace, places: Float, cameras: Float, step: float) -> Float:
    """Return the places that free steps join to those next to mapping cameras; the largest such set if none is near."""
    if len(places) == 0:
        return places
    a, b = cKDTree(places).query_pairs(1.5 * step, output_type="ndarray").T
    free = space.segments_are_free(places[a], places[b])
    steps = csr_array((np.ones(free.sum()), (a[free], b[free])), shape=(len(places), len(places)))
    part = connected_components(steps, directed=False)[1]
    distance, nearest = cKDTree(places[:, :2]).query(cameras[:, :2])
    joined = np.unique(part[nearest[distance < 1.0]])
    return places[np.isin(part, joined if len(joined) else np.bincount(part).argmax())]


def pitches_within(pitch_deg: tuple[float, float]) -> Float:
    """Return pitches from the lowest to the highest, at most 20 degrees apart."""
    low, high = pitch_deg
    return np.linspace(low, high, int(np.ceil((high - low) / 20 - 1e-9)) + 1)


def free_places(
    localization_map: LocalizationMap, space: Any, heights_m: tuple[float, ...], most: int
) -> tuple[Float, float]:
    """Return the places of all heights, as `camera_places`, and how far they are apart."""
    centers = camera_centers(mapping_views(localization_map)[0])
    found = [camera_places(space, centers, height, most) for height in heights_m or (None,)]
    return np.concatenate([places for places, _ in found]), max(apart for _, apart in found)


def places_at_heights(space: FreeSpace, places: Float, heights_m: tuple[float, ...]) -> Float:
    """Return the places (H * W, 3) m at each of the heights above the floor below places (W, 3).

    Raises ConfigError if there is no floor below one.
    """
    floor = space.floor_below(places)
    for row in np.flatnonzero(np.isnan(floor))[:1]:
        fix = "Give places above the floor, or leave the height out."
        raise ConfigError("there is no floor below a place", value=places[row].round(3).tolist(), fix=fix)
    moved = np.tile(places, (len(heights_m), 1))
    moved[:, 2] = np.add.outer(heights_m, floor).ravel()
    return moved


def yaws_around(camera: Camera) -> int:
    """Return how many views all around overlap by half of the camera's width, 6 to 12."""
    return int(np.clip(round(720 / max(field_of_view_deg(camera)[0], 1)), 6, 12))


def views_around(places: Float, n_yaws: int, pitches_deg: Float) -> tuple[Float, NDArray[np.int64]]:
    """Return poses (W * yaws * pitches, 3, 4) all around at places (W, 3), and the row of each one's place."""
    yaws = 360.0 / n_yaws * np.arange(n_yaws)
    axes = axes_of_angles(np.stack(np.meshgrid(yaws, pitches_deg), axis=-1).reshape(-1, 2))
    rows = np.repeat(np.arange(len(places)), len(axes))
    return poses_looking_along(places[rows], np.tile(axes, (len(places), 1))), rows


def drawn_views(
    places: Float, n: int, pitches_deg: Float, heading_deg: Float | None, pan_deg: tuple[float, float], seed: int
) -> tuple[Float, NDArray[np.int64]]:
    """Draw n poses, spread evenly over places (W, 3), and return the row of each one's place.

    Yaws are within limits relative to headings (W,); without headings, any.
    """
    rng = np.random.default_rng(seed)
    rows = np.arange(n) * len(places) // n
    low, high = (-180.0, 180.0) if heading_deg is None else pan_deg
    yaws = rng.uniform(low, high, len(rows)) + (0 if heading_deg is None else heading_deg[rows])
    angles = np.column_stack([yaws, rng.choice(pitches_deg, len(rows))])
    return poses_looking_along(places[rows], axes_of_angles(angles)), rows


def photograph_candidates(localization_map: LocalizationMap, space: Any, options: TargetOptions) -> Float:
    """Return about 2,400 poses (C, 3, 4) all around at places, each with others near enough to map a landmark together.

    Where places are coarse, they are half as many, and each has a partner 0.7 m beside it if there is free space.
    """
    yaws = yaws_around(localization_map.camera)
    pitches = pitches_within(options.pitch_deg)
    most = max(1, 2400 // (yaws * len(pitches) * max(1, len(options.height_m))))
    places, apart = free_places(localization_map, space, options.height_m, most)
    if apart > 1.0:
        places = places[::2]
        ring = 0.7 * axes_of_angles(np.column_stack([45.0 * np.arange(8), np.zeros(8)]))
        beside = places[:, None] + ring
        start, end = np.repeat(places, 8, axis=0), beside.reshape(-1, 3)
        free = space.segments_are_free(start, end)
        if isinstance(space, FreeSpace):  # on the same storey: at most a step or a slope between them
            free &= np.abs(space.floor_below(start) - space.floor_below(end)) < 0.5
        free = free.reshape(-1, 8)
        partners = beside[np.arange(len(places)), free.argmax(axis=1)]
        places = np.concatenate([places, partners[free.any(axis=1)]])
    return views_around(places, yaws, pitches)[0]
