"""Shares of labels, compared with numbers computed by hand on small tables, and their logging."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from labelled_tables import HALL, SHED, SPLITS
from synthetic_dataset import make_dataset
from wheretolook.commands.label import log_labels
from wheretolook.dataset.config import ALL
from wheretolook.dataset.viewpoint_files import read_table, write_table
from wheretolook.dataset.viewpoint_table import (
    LOCALIZED,
    NO_POSE,
    POSITIVE,
    TOO_FEW_MATCHES,
    UNLABELLED,
    label_shares,
    pooled_labels,
)
from wheretolook.tracking import TrackingConfig, artifact, newest_run
from wheretolook.utils.errors import TableError


def test_shares_by_hand():
    pooled = pooled_labels({"hall": HALL, "shed": SHED}, SPLITS)
    shares = label_shares(pooled).set_index(["scene", "split"])
    assert list(shares.index) == [("hall", "train"), ("shed", "test"), (ALL, "train"), (ALL, "test"), (ALL, ALL)]
    hall = shares.loc["hall", "train"]
    assert (hall["n_views"], hall["n_locations"]) == (8, 4)
    np.testing.assert_allclose(hall[list(POSITIVE)].astype(float), np.array([1, 2, 3, 4]) / 8)
    statuses = hall[[LOCALIZED, TOO_FEW_MATCHES, NO_POSE, "without_pose"]].astype(float)
    np.testing.assert_allclose(statuses, np.array([5, 1, 2, 2]) / 8)
    assert hall["locations_positive"] == 1 / 4
    assert hall["finest_of_coarsest"] == 1 / 4
    assert hall["same_label_share"] == 5 / 8
    assert hall["spearman"] == pytest.approx(pd.Series([1, 0, 0, 0, 0, 0, 0, 0]).corr(pd.Series([1] * 4 + [0] * 4)))
    assert hall["median_within_m"] == pytest.approx(0.202)
    assert hall["median_beyond_deg"] == pytest.approx(45.05)

    everything = shares.loc[ALL, ALL]
    assert (everything["n_views"], everything["n_locations"]) == (10, 5)  # location 0 of two scenes
    assert everything[POSITIVE[0]] == 2 / 10
    assert everything["locations_positive"] == 2 / 5
    pd.testing.assert_series_equal(shares.loc[ALL, "test"], shares.loc["shed", "test"], check_names=False)


def test_shares_of_both_localizers_by_hand():
    """By the first RANSAC result one view less is right in the shed, by 3 m, and none of the hall changes."""
    names = ("status", "error_m", "error_deg")
    hall, shed = (scene.assign(**{f"first_{name}": scene[name] for name in names}) for scene in (HALL, SHED))
    shed.loc[0, "first_error_m"] = 3.0
    everything = label_shares(pooled_labels({"hall": hall, "shed": shed}, SPLITS)).iloc[-1]
    assert (everything[POSITIVE[0]], everything[f"first_{POSITIVE[0]}"]) == (2 / 10, 1 / 10)
    assert (everything[POSITIVE[-1]], everything[f"first_{POSITIVE[-1]}"]) == (5 / 10, 5 / 10)


@pytest.fixture
def dataset(tmp_path):
    return make_dataset(tmp_path / "hut", ("train", "train", "test"), n_locations=5, n_directions=8, n_landmarks=100)


def test_logged_numbers_are_those_of_the_tables(dataset, tmp_path):
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    shares = log_labels(dataset, tracking, {"render": 1.5, "label": 20.0})
    run = newest_run(tracking, "label", {"dataset": "hut"})
    params = {"dataset": "hut", "dataset_fingerprint": dataset.fingerprint()}
    assert run.data.params == params | {"scenes": "scene-0 scene-1 scene-2"}
    metrics = run.data.metrics
    assert (metrics["n_views"], metrics["train_n_views"], metrics["seconds_label"]) == (120, 80, 20.0)
    for name in POSITIVE:
        assert metrics[name] == shares[name].iloc[-1]
        assert metrics[f"train_{name}"] == pytest.approx(shares[name].iloc[:2].mean())
    for name in ("labels.csv", "labels.md", "labels.png"):
        written = (dataset.root / "results" / name).read_bytes()
        assert artifact(tracking, run.info.run_id, name).read_bytes() == written
    pd.testing.assert_frame_equal(pd.read_csv(dataset.root / "results" / "labels.csv"), shares, check_dtype=False)


def test_unlabelled_or_empty_scenes_are_named(dataset, tmp_path):
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    path = dataset.scenes[1].table
    labelled = read_table(path)
    write_table(labelled.assign(status=labelled["status"].where(labelled.index != 3, UNLABELLED)), path)
    with pytest.raises(TableError):
        log_labels(dataset, tracking)
    with pytest.raises(TableError):
        log_labels(replace(dataset, scenes=()), tracking)
    assert not (dataset.root / "results").exists()
