"""Filling voxels whose centre is occupied from the nearest reachable voxels."""

from dataclasses import replace

import numpy as np
import pytest

from planning.test_path_planning import BOUNDS, Room, looking_north
from wheretolook.planning.scene_map import fill_partially_free_voxels
from wheretolook.utils.errors import MapFormatError


class BoundedRoom(Room):
    bounds = BOUNDS


def known_west_and_east():
    """Return voxel centres and a map that knows the outermost columns: scores are 0.25 in the west, 0.75 in the east."""
    whole = looking_north()
    centers = whole.grid.centers()
    known = np.flatnonzero((centers[:, 0] < 1) | (centers[:, 0] > 5))
    rows = np.full(len(whole.grid), -1, dtype=np.int32)
    rows[known] = np.arange(len(known))
    scores = np.where(centers[known, 0] < 3, 0.25, 0.75)[:, None] * np.ones((1, len(whole.directions)))
    return centers, replace(
        whole, row_of_voxel=rows, scores=scores.astype(np.float32), ranked=whole.ranked[: len(known)],
        n_visible=whole.n_visible[: len(known)],
    )  # fmt: skip


def test_views_are_not_copied_through_walls():
    centers, own = known_west_and_east()
    filled = fill_partially_free_voxels(own, BoundedRoom())
    known = own.row_of_voxel >= 0
    assert (~known).sum() > (filled.row_of_voxel < 0).sum()
    np.testing.assert_array_equal(filled.row_of_voxel[known], own.row_of_voxel[known])
    room = Room()
    sources = centers[own.voxel_of_row]
    for voxel in np.flatnonzero(~known & (filled.row_of_voxel >= 0) & room.is_free(centers)):
        distance = np.linalg.norm(sources - centers[voxel], axis=1)
        reachable = room.segments_are_free(np.tile(centers[voxel], (len(sources), 1)), sources)
        row = filled.row_of_voxel[voxel]
        assert reachable[row] and distance[row] <= distance[reachable].min() + 1e-9
    near_the_wall = (centers[:, 1] < 2.9) & (np.abs(centers[:, 0] - 3) < 1)
    for side, score in ((centers[:, 0] < 3, 0.25), (centers[:, 0] > 3, 0.75)):
        rows = filled.row_of_voxel[near_the_wall & side]
        assert (rows >= 0).all() and (filled.scores[rows] == score).all()


def test_a_filled_map_is_derived(tmp_path):
    filled = fill_partially_free_voxels(known_west_and_east()[1], BoundedRoom())
    assert filled.origin.derived
    with pytest.raises(MapFormatError):
        filled.save(tmp_path / "map")
    with pytest.raises(ValueError):
        _ = filled.locations
