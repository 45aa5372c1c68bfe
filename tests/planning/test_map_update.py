"""Viewpoint maps brought up to date against maps built anew."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from planning.rooms import DIRECTIONS, GRID, build, free_voxels, joined, occlusion, room_landmarks, room_map
from scorers.test_scorers import weights_of
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.planning.map_building import build_viewpoint_map, update_viewpoint_map
from wheretolook.planning.scene_map import shares_below
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
    added = rows_of(more, np.sort(np.argsort(sights.sum(0))[:12]))
    return added


def assert_same(a: ViewpointMap, b: ViewpointMap) -> None:
    names = ("row_of_voxel", "ranked", "scores", "n_visible", "directions", "landmark_ids", "landmark_digests")
    for name in names:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    assert a.origin == b.origin


@pytest.mark.parametrize("method", ["bins", "fisher-trace-exact"])
def test_added_landmarks_change_the_voxels_that_see_them(method: str) -> None:
    old = build(OLD, method)
    added = seen_by_some()
    kept = old.scores.copy()
    # ids between the old ones: rows move
    added = replace(added, ids=np.arange(len(added)) * 10 + 3)
    landmarks = joined(replace(OLD, ids=OLD.ids * 10), added)
    old = build(replace(OLD, ids=OLD.ids * 10), method)
    new, changed = update_viewpoint_map(old, make_scorer(method, room_map(landmarks)))
    sees = occlusion().unoccluded(old.locations, added.points).any(axis=1)
    assert 0 < sees.sum() < len(sees)
    np.testing.assert_array_equal(changed, old.voxel_of_row[sees])
    assert_same(new, build(landmarks, method))
    assert np.any(new.n_visible != old.n_visible)
    np.testing.assert_array_equal(old.scores, kept)  # the old map stays as it is


@pytest.mark.parametrize("case", ["removed", "moved", "shares"])
def test_what_can_change_any_voxel_scores_all_of_them_again(case: str) -> None:
    method = "visible" if case == "shares" else "bins"
    landmarks = {
        "removed": rows_of(OLD, np.arange(399)),
        "moved": replace(OLD, points=OLD.points + np.where(np.arange(400) == 3, 0.1, 0)[:, None]),
        "shares": joined(OLD, room_landmarks(3, seed=9, first_id=1000)),  # of the number of the map's landmarks
    }[case]
    old = build(OLD, method)
    new, changed = update_viewpoint_map(old, make_scorer(method, room_map(landmarks)))
    np.testing.assert_array_equal(changed, old.voxel_of_row)
    assert_same(new, build(landmarks, method))


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


@pytest.mark.parametrize("method", [name for name, known in scorers().items() if not known.weights])
def test_methods_that_call_themselves_local_are(method: str) -> None:
    landmarks = joined(OLD, seen_by_some())
    old, new = (make_scorer(method, room_map(of)) for of in (OLD, landmarks))
    if not old.local:
        return
    before = build_viewpoint_map(old, GRID, free_voxels(), DIRECTIONS)
    after = build_viewpoint_map(new, GRID, free_voxels(), DIRECTIONS)
    hidden = ~occlusion().unoccluded(before.locations, landmarks.points[len(OLD) :]).any(axis=1)
    assert hidden.any()
    np.testing.assert_allclose(after.scores[hidden], before.scores[hidden], rtol=1e-6)


@pytest.mark.parametrize("method", ["set", "expected-bins"])
def test_methods_that_have_learnt_update_as_if_built_again(method: str, tmp_path: Path) -> None:
    landmarks = joined(OLD, seen_by_some())
    needed = scorers()[method].weights
    weights = weights_of(needed, tmp_path / "some.safetensors", room_map(OLD))
    before, after = (make_scorer(method, room_map(of), weights=weights) for of in (OLD, landmarks))
    old = build_viewpoint_map(before, GRID, free_voxels(), DIRECTIONS)
    new, changed = update_viewpoint_map(old, after)
    assert after.local and 0 < len(changed) < len(old.scores)
    again = build_viewpoint_map(after, GRID, free_voxels(), DIRECTIONS)
    np.testing.assert_allclose(new.scores, again.scores, rtol=1e-5)
    np.testing.assert_array_equal(new.n_visible, again.n_visible)


@pytest.mark.parametrize("change", ["scorer", "camera", "occlusion", "weights", "derived"])
def test_invalid_updates(change: str) -> None:
    old = build(OLD)
    landmarks = joined(OLD, seen_by_some())
    scorer = make_scorer("bins", room_map(landmarks))
    if change == "scorer":
        scorer = make_scorer("random", room_map(landmarks))
    elif change == "camera":
        scorer = make_scorer("bins", LocalizationMap(landmarks, PinholeCamera(160, 120, 81.0), occlusion()))
    elif change == "occlusion":
        scorer = make_scorer("bins", room_map(landmarks, NoOcclusion()))
    elif change == "weights":
        old = replace(old, scores=old.scores + np.float32(0.01))
    else:
        old = shares_below(old)
    with pytest.raises(ConfigError):
        update_viewpoint_map(old, scorer)
