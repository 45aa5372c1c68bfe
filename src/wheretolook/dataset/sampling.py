"""Samples a table of viewpoints in a map: the K directions of each location that see most (paper, Sec. 3.1-3.2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from wheretolook.dataset.config import SampleConfig
from wheretolook.dataset.viewpoint_table import CAMERA_ID, UNLABELLED, pose_columns
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.poses import Float, camera_centers, poses_looking_along, rotation_looking_along
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.space.free_space import FreeSpace
from wheretolook.space.mapped_space import MappedSpace
from wheretolook.utils.devices import fitting
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.visibility.counting import Survey, SurveyOptions, survey
from wheretolook.visibility.occlusion import OcclusionModel, StoredOcclusion


def free_locations(grid: VoxelGrid, free_space: FreeSpace | MappedSpace) -> NDArray[np.int64]:
    """Ids of the grid's locations in free space, ascending. Raises SceneError if there is none."""
    ids = np.flatnonzero(free_space.is_free(grid.centers()))
    if len(ids) == 0:
        problem = f"none of the {len(grid)} locations is in free space"
        fix = "Refine sample.grid, lower the clearance, or check the scene's units (metres) and up axis."
        raise SceneError(problem, value=(grid.lower, grid.upper), fix=fix)
    return ids


def sample_viewpoints(
    grid: VoxelGrid,
    location_ids: ArrayLike,
    landmarks: Landmarks,
    cameras: Camera | Mapping[int, Camera],
    occlusion: OcclusionModel,
    config: SampleConfig = SampleConfig(),
    device: str = "cpu",
    progress: str | None = None,
    mapped: Float | None = None,
) -> tuple[pd.DataFrame, StoredOcclusion]:
    """Choose the viewpoints that see most landmarks at locations (L,) of the grid, and return them with the occlusion.

    At every location all directions of the lattice are ranked by the number of landmarks in view (descending, then by
    direction id), and the best K are kept. Several cameras, by number, are assigned to the locations in turn.
    With `config.near_map`, a share is near the mapping images, whose poses (M, 3, 4) are `mapped`.
    `progress` is the text of a progress bar; `config.max_directions` that of the scene's split. The table is unlabelled
    and sorted by viewpoint id: location id times the number of directions, plus direction id.

    Raises:
        SceneError: no viewpoint sees enough landmarks, or a location is inside geometry.
        MapError: there are no landmarks.
        ConfigError: so many viewpoints do not fit into memory.
    """
    rng = np.random.default_rng(config.seed)
    ids = np.asarray(location_ids, dtype=np.int64)
    n_others = config.max_locations or len(ids)
    near = ids[:0]
    if config.near_map and mapped is not None:
        near = ids[_near_map(grid.centers()[ids], mapped, round(config.near_map * config.max_locations), rng)]
        ids = np.setdiff1d(ids, near)
        n_others -= len(near)
    ids = np.sort(np.concatenate([near, _subset(ids, n_others, rng) if n_others else ids[:0]]))
    locations = grid.centers()[ids]
    directions = config.axes()
    options = SurveyOptions(
        keep=0 if len(near) else config.keep,
        device=device,
        memory_bytes=round(config.memory_gb * 1e9),
        progress=progress,
    )
    rotations = rotation_looking_along(directions)
    several = cameras if isinstance(cameras, Mapping) else {0: cameras}
    numbers = np.array(list(several))[np.arange(len(ids)) % len(several)]
    if len(several) > 1:
        rng.shuffle(numbers)
    groups = [np.flatnonzero(numbers == number) for number in several]
    parts = [
        survey(camera, rotations, locations[rows], landmarks.points, occlusion, options)
        for camera, rows in zip(several.values(), groups, strict=True)
        if len(rows)
    ]
    seen = _joined(parts, np.concatenate(groups), locations)
    most = config.directions_of("train")
    visible = [best[counts[best] >= config.min_visible] for counts, best in zip(seen.counts, seen.best, strict=True)]
    if len(near):
        assert mapped is not None
        visible = _along_map(visible, np.isin(ids, near), locations, directions, mapped)
    kept = [np.sort(_subset(seen_there[: config.keep or None], most, rng)) for seen_there in visible]
    location = np.repeat(np.arange(len(ids)), [len(chosen) for chosen in kept])
    direction = np.concatenate(kept)
    _check_number(len(direction), len(ids), int(seen.counts.max(initial=0)), len(landmarks.points), config)
    rank = np.full(seen.counts.shape, -1, dtype=np.int32)
    np.put_along_axis(rank, seen.best, np.arange(seen.best.shape[1])[None], axis=1)
    columns = {
        "viewpoint_id": ids[location] * len(directions) + direction,
        "location_id": ids[location],
        "direction_id": direction,
        **pose_columns(poses_looking_along(locations[location], directions[direction])),
        "n_visible": seen.counts[location, direction],
        "visibility_rank": rank[location, direction],
    }
    if isinstance(cameras, Mapping):
        columns[CAMERA_ID] = numbers[location].astype(np.int32)
    nan = np.float32(np.nan)
    assert seen.occlusion is not None
    table = pd.DataFrame(columns).assign(status=UNLABELLED, error_m=nan, error_deg=nan, n_inliers=0)
    return table, seen.occlusion


def _near_map(locations: Float, mapped: Float, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw rows of at most `count` locations (L, 3), each nearest to a point near a random mapping image."""
    centers = camera_centers(mapped)[rng.integers(len(mapped), size=count)]
    return np.unique(cKDTree(locations).query(centers + rng.normal(0, 0.2, centers.shape))[1])


def _along_map(
    visible: Sequence[NDArray[np.int64]], near: NDArray[np.bool_], locations: Float, directions: Float, mapped: Float
) -> list[NDArray[np.int64]]:
    """Keep, at locations (L, 3) that are `near` (L,), only directions like that of the nearest mapping image."""
    nearest = cKDTree(camera_centers(mapped)).query(locations)[1]
    like = directions @ mapped[nearest, 2, :3].T > np.cos(np.radians(40))
    return [
        seen[like[seen, row]] if is_near else seen
        for row, (seen, is_near) in enumerate(zip(visible, near, strict=True))
    ]


def _check_number(n_viewpoints: int, n_locations: int, max_count: int, n_landmarks: int, config: SampleConfig) -> None:
    """Raise SceneError without viewpoints, ConfigError if there are more than memory holds."""
    if n_viewpoints == 0:
        fix = "Lower sample.min_visible, or map the scene with more images."
        problem = f"from no location does a viewpoint see {config.min_visible} of the {n_landmarks} landmarks"
        raise SceneError(problem, value=max_count, fix=fix)
    most = fitting(600)  # while a table is made and written
    if n_viewpoints > most:
        fix = f"Set sample.max_directions to {max(1, most // n_locations):,} or less, or sample.max_locations."
        raise ConfigError("the table has more viewpoints than there is memory for", value=n_viewpoints, fix=fix)


def _joined(parts: Sequence[Survey], rows: NDArray[np.int64], locations: Float) -> Survey:
    """Join surveys that together hold `rows` of locations (L, 3), in that order."""
    if len(parts) == 1:
        return parts[0]
    order = np.argsort(rows)
    stored = [part.occlusion for part in parts if part.occlusion is not None]
    packed = np.concatenate([part.packed for part in stored])[order]
    counts, best = (np.concatenate([getattr(part, name) for part in parts])[order] for name in ("counts", "best"))
    return Survey(counts, best, StoredOcclusion(locations, packed, stored[0].n_landmarks, stored[0].name))


def _subset(values: NDArray[np.int64], at_most: int, rng: np.random.Generator) -> NDArray[np.int64]:
    if at_most == 0 or len(values) <= at_most:
        return values
    return rng.choice(values, at_most, replace=False)
