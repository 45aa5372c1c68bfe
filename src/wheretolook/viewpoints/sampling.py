"""From a map to a table of viewpoints: locations, directions, visibility, the best K kept (paper, Sec. 3.1-3.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, get_args

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import Lattice, VoxelGrid, direction_lattice
from wheretolook.geometry.poses import poses_looking_along, rotation_looking_along
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.viewpoints.table import UNLABELLED, Split, pose_columns
from wheretolook.visibility.occlusion import OcclusionModel, StoredOcclusion
from wheretolook.visibility.survey import survey

if TYPE_CHECKING:
    from wheretolook.space.free_space import FreeSpace
    from wheretolook.space.mapped_space import MappedSpace


@dataclass(frozen=True)
class SampleConfig:
    """Settings of the sample stage.

    Args:
        grid: voxels along x, y and z over the scene's bounds; the paper has 8 x 8 x 8.
        directions: directions at each location; the released code has 500.
        lattice: how they are spread: "fibonacci" is even, "azimuth-elevation" is the paper's comparison, "released" is
            what the released code does, "yaw-pitch" are ActLoc's 6 pitches x 18 yaws, whatever `directions` says.
        keep: K, the directions kept at each location, those that see most landmarks; 0 keeps all.
        min_visible: directions that see fewer landmarks are dropped ("none or only a minimal number", Sec. 3.2).
        max_locations: a random subset of the free locations, 0 for all.
        max_directions: a random subset of the kept directions of each location, 0 for all; one number, or one for
            each split, such as `{train: 50, val: 50, test: 100}`.
        seed: of those subsets.
        distinct_pixels: rank by the number of distinct pixels with a landmark, as the released code counts, instead of
            the number of landmarks.
        memory_gb: bound on the memory that counting takes on its device, in 10^9 bytes.
    """

    grid: tuple[int, int, int] = (8, 8, 8)
    directions: int = 500
    lattice: Lattice = "fibonacci"
    keep: int = 100
    min_visible: int = 1
    max_locations: int = 0
    max_directions: int | dict[Split, int] = 0
    seed: int = 0
    distinct_pixels: bool = False
    memory_gb: float = 2.0

    def __post_init__(self) -> None:
        for name in ("keep", "min_visible", "max_locations"):
            if getattr(self, name) < 0:
                raise ConfigError(f"sample.{name} must not be negative", value=getattr(self, name))
        if isinstance(self.max_directions, dict) and set(self.max_directions) != set(get_args(Split)):
            fix = "Give one number, or one for each of train, val and test."
            raise ConfigError("sample.max_directions lacks or misnames a split", value=self.max_directions, fix=fix)
        if min(map(self.directions_of, get_args(Split))) < 0:
            raise ConfigError("sample.max_directions must not be negative", value=self.max_directions)
        if not 0 < self.memory_gb < float("inf"):
            raise ConfigError("sample.memory_gb must be positive", value=self.memory_gb)

    def directions_of(self, split: Split) -> int:
        """`max_directions` for a split."""
        return self.max_directions[split] if isinstance(self.max_directions, dict) else self.max_directions


def free_locations(grid: VoxelGrid, free_space: FreeSpace | MappedSpace) -> NDArray[np.int64]:
    """Ids of the grid's locations in free space, ascending.

    Raises:
        SceneError: there is none.
    """
    ids = np.flatnonzero(free_space.is_free(grid.centers()))
    if len(ids) == 0:
        raise SceneError(
            f"none of the {len(grid)} locations is in free space",
            value=(grid.lower, grid.upper),
            fix="Refine sample.grid, lower the clearance, or check the scene's units (metres) and up axis.",
        )
    return ids


def sample_viewpoints(
    grid: VoxelGrid,
    location_ids: ArrayLike,
    landmarks: Landmarks,
    camera: PinholeCamera,
    occlusion: OcclusionModel,
    config: SampleConfig | None = None,
    device: str = "cpu",
    progress: str | None = None,
    split: Split = "train",
) -> tuple[pd.DataFrame, StoredOcclusion]:
    """Choose viewpoints by what they see.

    At every location all directions of the lattice are ranked by the number of landmarks in view (descending, then by
    direction id), and the best K are kept.

    Args:
        grid: voxel grid; a location is the centre of a voxel.
        location_ids: ids of the locations to use, (L,).
        landmarks: of the map.
        camera: intrinsics of the viewpoints.
        occlusion: which landmarks have a free line of sight.
        config: how many of what.
        device: where visibility is counted.
        progress: text of a progress bar; None shows none.
        split: the scene's, for an option that differs by split.

    Raises:
        SceneError: no viewpoint sees enough landmarks, or a location lies inside geometry. MapError: no landmarks.

    Returns:
        The table of viewpoints, unlabelled, in the order of their ids; a viewpoint's id is its location's times the
        number of directions plus its direction's. And the occlusion of the table's locations, for later stages.
    """
    config = config or SampleConfig()
    rng = np.random.default_rng(config.seed)
    ids = np.sort(_subset(np.asarray(location_ids, dtype=np.int64), config.max_locations, rng))
    locations = grid.centers()[ids]
    directions = direction_lattice(config.directions, config.lattice)
    seen = survey(
        camera, rotation_looking_along(directions), locations, landmarks.points, occlusion, keep=config.keep,
        distinct_pixels=config.distinct_pixels, device=device, memory_bytes=round(config.memory_gb * 1e9),
        progress=progress,
    )  # fmt: skip
    counts, rank = seen.counts, np.full(seen.counts.shape, -1)
    np.put_along_axis(rank, seen.best, np.arange(seen.best.shape[1])[None], axis=1)

    rows, columns = [], []
    for row in range(len(ids)):
        kept = seen.best[row]
        kept = kept[counts[row, kept] >= config.min_visible]
        kept = np.sort(_subset(kept, config.directions_of(split), rng))
        rows.append(np.full(len(kept), row))
        columns.append(kept)
    row_index, direction = np.concatenate(rows), np.concatenate(columns)
    if len(direction) == 0:
        raise SceneError(
            f"from no location does a viewpoint see {config.min_visible} of the {len(landmarks.points)} landmarks",
            value=int(counts.max(initial=0)),
            fix="Lower sample.min_visible, or map the scene with more images.",
        )
    table = pd.DataFrame(
        {
            "viewpoint_id": ids[row_index] * len(directions) + direction,
            "location_id": ids[row_index],
            "direction_id": direction,
            **pose_columns(poses_looking_along(locations[row_index], directions[direction])),
            "n_visible": counts[row_index, direction],
            "visibility_rank": rank[row_index, direction],
        }
    )
    unlabelled = table.assign(status=UNLABELLED, error_m=np.float32(np.nan), error_deg=np.float32(np.nan), n_inliers=0)
    assert seen.occlusion is not None
    return unlabelled, seen.occlusion


def _subset(values: NDArray[np.int64], at_most: int, rng: np.random.Generator) -> NDArray[np.int64]:
    if at_most == 0 or len(values) <= at_most:
        return values
    return rng.choice(values, at_most, replace=False)
