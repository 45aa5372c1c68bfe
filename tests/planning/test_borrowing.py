"""Voxels whose centre is occupied have the views of those that can be reached from them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from planning.test_path_planning import BOUNDS, Room, looking_north
from wheretolook.planning.scene_map import fill_partially_free_voxels
from wheretolook.utils.errors import MapFormatError


class BoundedRoom(Room):
    bounds = BOUNDS


def known_west_and_east() -> tuple:
    """Of the map of the room, only the voxels of the outermost columns are known; scores tell which."""
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


def test_views_are_not_taken_through_walls() -> None:
    centers, own = known_west_and_east()
    lent = fill_partially_free_voxels(own, BoundedRoom())
    assert (own.row_of_voxel < 0).sum() > (lent.row_of_voxel < 0).sum()
    np.testing.assert_array_equal(lent.row_of_voxel[own.row_of_voxel >= 0], own.row_of_voxel[own.row_of_voxel >= 0])
    room = Room()
    for voxel in np.flatnonzero((own.row_of_voxel < 0) & (lent.row_of_voxel >= 0)):
        lender = own.voxel_of_row[lent.row_of_voxel[voxel]]
        if room.is_free(centers[voxel : voxel + 1])[0]:
            assert room.segments_are_free(centers[voxel : voxel + 1], centers[lender : lender + 1])[0]
            nearer = np.linalg.norm(centers[own.voxel_of_row] - centers[voxel], axis=1)
            reach = room.segments_are_free(np.tile(centers[voxel], (len(nearer), 1)), centers[own.voxel_of_row])
            assert nearer[lent.row_of_voxel[voxel]] <= nearer[reach].min() + 1e-9
    beside_the_wall = (centers[:, 1] < 2.9) & (np.abs(centers[:, 0] - 3) < 1)
    west = lent.row_of_voxel[beside_the_wall & (centers[:, 0] < 3)]
    assert (west >= 0).all() and (lent.scores[west] == 0.25).all()
    east = lent.row_of_voxel[beside_the_wall & (centers[:, 0] > 3)]
    assert (east >= 0).all() and (lent.scores[east] == 0.75).all()


def test_a_filled_map_is_derived(tmp_path: Path) -> None:
    filled = fill_partially_free_voxels(known_west_and_east()[1], BoundedRoom())
    assert filled.origin.derived
    with pytest.raises(MapFormatError):
        filled.save(tmp_path / "map")
    with pytest.raises(ValueError):
        _ = filled.locations
