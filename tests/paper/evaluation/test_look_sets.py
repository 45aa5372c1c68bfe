"""Sets of looks joined from stored matches: their labels, the comparison of strategies, and when to stop looking."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from paper.matched_views import matched_views
from synthetic_dataset import CAMERA, make_scene
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_files import read_table, write_table
from wheretolook.dataset.viewpoint_table import poses
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.localization.confidence import confidence_features
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.tracking import TrackingConfig, newest_run
from wheretolook.utils.errors import PoseError, TableError
from wheretolook_paper.commands.reports import evaluate_look_sets
from wheretolook_paper.evaluation.looks import SET_COLUMNS, label_sets, look_table, stopping_table

WEIGHTS = Path(__file__).parents[3] / "data" / "release" / "weights" / "set.safetensors"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Half of the matches of each view are wrong."""
    root = tmp_path_factory.mktemp("data") / "tiny"
    scene = make_scene(root / "one", "test", 0, n_locations=6, n_directions=16, n_landmarks=600)
    table = read_table(scene.table)
    labels = matched_views(Landmarks.load(scene.landmarks).points, CAMERA, poses(table), np.full(len(table), 0.5))
    write_table(table.assign(**labels), scene.table)
    scene.stage_cache("label", "key").store()
    made = Dataset(root, (scene,))
    made.save()
    return made


@pytest.fixture(scope="module")
def table(dataset):
    return read_table(dataset.scenes[0].table, pixels=True)


@pytest.fixture(scope="module")
def points(dataset):
    return Landmarks.load(dataset.scenes[0].landmarks).points


def test_a_set_of_one_has_the_label_of_its_view(table, points):
    rows = np.flatnonzero(table["n_inliers"] > 0)[:20]
    labelled = label_sets(table, rows[:, None], points, CAMERA)
    assert list(labelled.columns) == list(SET_COLUMNS)
    for name in ("status", "n_inliers", "location_id"):
        assert list(labelled[name]) == list(table[name].to_numpy()[rows])
    np.testing.assert_allclose(labelled["error_m"], table["error_m"].to_numpy()[rows], rtol=1e-3)


def test_sets_localize_where_their_looks_do_not(table, points):
    """Of each place's four middling looks the joint pose is better than the best of their own."""
    sets = []
    for _, part in table.groupby("location_id"):
        middling = part.index[part["n_inliers"].between(8, 22)][:4]
        if len(middling) == 4:
            sets.append(middling.to_numpy())
    assert len(sets) >= 3
    labelled = label_sets(table, sets, points, CAMERA)
    alone = [np.nanmin(table["error_m"].to_numpy()[rows]) for rows in sets]
    assert (labelled["status"] == "localized").all() and labelled["error_m"].max() < 0.1
    assert np.median(labelled["error_m"]) < np.median(alone)
    assert (labelled["elsewhere"] < labelled["support"]).all() and (labelled["deviation_m"] < 0.2).all()


def test_invalid_sets(table, points):
    first, other = (np.flatnonzero(table["location_id"] == location)[0] for location in (0, 1))
    seen = int(np.flatnonzero(table["n_inliers"] > 0)[0])
    for views, rows, landmarks, error in (
        (table, [first, other], points, PoseError),
        (table.drop(columns="matched_pixels"), [0], points, TableError),
        (table, [], points, TableError),
        (table, [len(table)], points, TableError),
        (table, [seen], points[:3], TableError),
    ):
        with pytest.raises(error):
            label_sets(views, [rows], landmarks, CAMERA)


def test_strategies_are_compared_and_logged(dataset, tmp_path):
    tracking = TrackingConfig(tmp_path / "mlruns")
    strategies = ("together", "in-turn", "one-by-one", "even", "fisher")
    found = evaluate_look_sets(
        dataset, EvaluateConfig(weights=(WEIGHTS,)), tracking, "cpu", (1, 2), strategies, progress=False
    )
    assert found is not None and len(found) == 10
    good = found.set_index(["strategy", "n_looks"])
    ones = good.loc[[(name, 1) for name in ("together", "in-turn", "one-by-one", "even")]]
    assert (ones["gain"] == 0).all() and ones["good"].nunique() == 1
    assert (good.loc[("together", 2), "good"]) >= ones["good"].iloc[0]
    assert (found["good_low"] <= found["good"]).all() and (found["good"] <= found["good_high"]).all()
    assert (dataset.root / "results" / "looks.md").is_file()
    assert newest_run(tracking, "looks") is not None
    pd.testing.assert_frame_equal(pd.read_csv(dataset.root / "results" / "looks.csv"), found, check_dtype=False)


def test_one_stops_when_sure_enough():
    """Two places: sure after one look, and only after three; by hand."""
    columns = {"strategy": "in-turn", "scene": "a", "n_looks": [1, 2, 3] * 2, "location_id": [0] * 3 + [1] * 3}
    columns |= {"confidence": [0.95, 0.97, 0.99, 0.2, 0.6, 0.995], "good": [True, True, True, False, False, True]}
    stops = stopping_table(pd.DataFrame(columns), asked=(0.5, 0.9, 0.999)).set_index("asked")
    assert stops["looks"].tolist() == [1.5, 2.0, 3.0]
    assert stops["good"].tolist() == [0.5, 1.0, 1.0] and stops["of_most"].tolist() == [0.5, 1.0, 1.0]
    whole = pd.DataFrame(columns).assign(single_good=[True] * 3 + [False] * 3, any_good=True)
    shares = look_table(whole).set_index("n_looks")
    assert shares["good"].tolist() == [0.5, 0.5, 1.0] and shares["gain"].tolist() == [0.0, 0.0, 0.5]
    assert shares.loc[3, "sure"] == 1.0 and shares.loc[3, "sure_right"] == 1.0


def test_features_of_the_confidence_by_hand():
    features = confidence_features([99], [200], [0], [30], [10], [np.inf])
    np.testing.assert_allclose(features[0], [0, np.log(99.5 / 201), np.log(2), np.log(10)])
