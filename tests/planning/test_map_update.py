"""Viewpoint maps brought up to date against maps built again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from planning.rooms import CAMERA, DIRECTIONS, GRID, build, free_voxels, joined, occlusion, room_landmarks, room_map
from scorers.test_scorers import weights_of
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.planning.scene_map import build_viewpoint_map, shares_below, update_viewpoint_map
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.scorers.registry import make_scorer, scorers
from wheretolook.utils.errors import ConfigError
from wheretolook.visibility.hidden_points import HiddenPointRemoval
from wheretolook.visibility.occlusion import NoOcclusion, OcclusionModel, StoredOcclusion

OLD = room_landmarks(400)


def rows_of(landmarks: Landmarks, rows: np.ndarray) -> Landmarks:
    return Landmarks(**{name: None if value is None else value[rows] for name, value in vars(landmarks).items()})


def seen_by_some() -> Landmarks:
    """Added landmarks that are hidden from some voxels, those with the fewest who see them."""
    more = room_landmarks(200, seed=5, first_id=1000)
    sights = occlusion().unoccluded(GRID.centers()[list(free_voxels())], more.points)
    return rows_of(more, np.sort(np.argsort(sights.sum(0))[:12]))


def assert_same(a: ViewpointMap, b: ViewpointMap) -> None:
    names = ("row_of_voxel", "ranked", "scores", "n_visible", "directions", "landmark_ids", "landmark_digests")
    for name in names:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    assert a.origin == b.origin


METHODS = [*(name for name, known in scorers().items() if not known.weights), "set", "expected-bins"]


@pytest.mark.parametrize("method", METHODS)
def test_added_landmarks_change_the_voxels_that_see_them(method: str, tmp_path: Path) -> None:
    added = seen_by_some()
    added = replace(added, ids=np.arange(len(added)) * 10 + 3)  # ids between the old ones: rows move
    before = replace(OLD, ids=OLD.ids * 10)
    landmarks = joined(before, added)
    needed = scorers()[method].weights
    weights = weights_of(needed, tmp_path / "some.safetensors", room_map(OLD)) if needed else None
    first, scorer = (make_scorer(method, room_map(of), weights=weights) for of in (before, landmarks))
    old = build_viewpoint_map(first, GRID, free_voxels(), DIRECTIONS)
    kept = old.scores.copy()
    new, changed = update_viewpoint_map(old, scorer)
    sees = occlusion().unoccluded(old.locations, added.points).any(axis=1)
    assert 0 < sees.sum() < len(sees)
    np.testing.assert_array_equal(changed, old.voxel_of_row[sees | (not scorer.local)])
    again = build_viewpoint_map(scorer, GRID, free_voxels(), DIRECTIONS)
    np.testing.assert_allclose(new.scores, again.scores, rtol=1e-5)
    np.testing.assert_array_equal(new.n_visible, again.n_visible)
    np.testing.assert_array_equal(old.scores, kept)  # the old map stays as it is


@pytest.mark.parametrize("case", ["removed", "moved"])
def test_removed_and_moved_landmarks_update_every_voxel(case: str) -> None:
    moved = replace(OLD, points=OLD.points + np.where(np.arange(400) == 3, 0.1, 0)[:, None])
    landmarks = moved if case == "moved" else rows_of(OLD, np.arange(399))
    old = build(OLD)
    new, changed = update_viewpoint_map(old, make_scorer("bins", room_map(landmarks)))
    np.testing.assert_array_equal(changed, old.voxel_of_row)
    assert_same(new, build(landmarks))


@pytest.mark.parametrize("name", ["stored", "hidden-points", "none"])
def test_every_occlusion_model_updates_exactly(name: str) -> None:
    added = seen_by_some()
    landmarks = joined(OLD, added)
    locations = GRID.centers()[list(free_voxels())]

    def model(of: Landmarks) -> OcclusionModel:
        if name == "stored":
            return StoredOcclusion.from_mask(locations, occlusion().unoccluded(locations, of.points))
        return HiddenPointRemoval() if name == "hidden-points" else NoOcclusion()

    def scorer(of: Landmarks):
        return make_scorer("bins", room_map(of, model(of)))

    old = build_viewpoint_map(scorer(OLD), GRID, free_voxels(), DIRECTIONS)
    new, changed = update_viewpoint_map(old, scorer(landmarks))
    assert_same(new, build_viewpoint_map(scorer(landmarks), GRID, free_voxels(), DIRECTIONS))
    assert (len(changed) == len(locations)) == (name != "stored")


@pytest.mark.parametrize("change", ["scorer", "camera", "occlusion", "weights", "derived"])
def test_invalid_updates(change: str) -> None:
    old = build(OLD)
    old = {"weights": replace(old, scores=old.scores + np.float32(0.01)), "derived": shares_below(old)}.get(change, old)
    landmarks = joined(OLD, seen_by_some())
    camera = PinholeCamera(160, 120, 81.0) if change == "camera" else CAMERA
    model = NoOcclusion() if change == "occlusion" else occlusion()
    method = "random" if change == "scorer" else "bins"
    with pytest.raises(ConfigError):
        update_viewpoint_map(old, make_scorer(method, LocalizationMap(landmarks, camera, model)))
