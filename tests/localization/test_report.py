"""Statistics of labels, compared with numbers computed by hand on small tables, and their logging."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from synthetic_dataset import make_dataset
from wheretolook.commands.label import log_labels
from wheretolook.dataset.config import ALL
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_files import read_table, write_table
from wheretolook.dataset.viewpoint_table import LOCALIZED, NO_POSE, TOO_FEW_MATCHES, UNLABELLED, pose_columns
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.localization.report import POSITIVE, label_markdown, label_summary
from wheretolook.tracking.runs import artifact, newest_run
from wheretolook.tracking.store import TrackingConfig
from wheretolook.utils.errors import TableError

NAN = float("nan")


def table(rows: list[tuple[int, float, int, str, float, float]]) -> pd.DataFrame:
    """Viewpoints of rows (location, its height, landmarks in view, status, errors in metres and degrees)."""
    names = ["location_id", "z", "n_visible", "status", "error_m", "error_deg"]
    frame = pd.DataFrame(rows, columns=names)
    centers = np.column_stack([np.full((len(rows), 2), 7.0), frame.pop("z")])
    directions = np.random.default_rng(0).normal(size=(len(rows), 3))  # heights must not depend on the orientation
    return frame.assign(**pose_columns(poses_looking_along(centers, directions)))


HALL = table(
    [
        (0, -2.0, 5000, LOCALIZED, 0.004, 0.1),  # positive everywhere
        (0, -2.0, 400, LOCALIZED, 0.004, 0.4),  # the finest limit is exclusive
        (1, -2.0, 99, LOCALIZED, 0.4, 4.0),
        (2, -1.3, 100, LOCALIZED, 4.0, 9.0),
        (2, -1.3, 9, LOCALIZED, 4.0, 90.0),
        (2, -1.3, 5, NO_POSE, 0.004, 0.1),  # too few inliers: never positive
        (3, 1.1, 0, TOO_FEW_MATCHES, NAN, NAN),
        (3, 1.1, 2, NO_POSE, NAN, NAN),
    ]
)
SHED = table([(0, 10.0, 1000, LOCALIZED, 0.002, 0.2), (0, 10.0, 50, NO_POSE, 500.0, 179.0)])


@pytest.fixture
def summary():  # type: ignore[no-untyped-def]
    return label_summary({"hall": HALL, "shed": SHED}, {"hall": "train", "shed": "test"})


def test_shares_by_hand(summary) -> None:  # type: ignore[no-untyped-def]
    shares = summary.shares.set_index(["scene", "split"])
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


def test_shares_of_both_localizers_by_hand() -> None:
    """By the first RANSAC result one view less is right in the shed, by 3 m, and none of the hall changes."""
    names = ("status", "error_m", "error_deg")
    hall, shed = (scene.assign(**{f"first_{name}": scene[name] for name in names}) for scene in (HALL, SHED))
    shed.loc[0, "first_error_m"] = 3.0
    splits = {"hall": "train", "shed": "test"}
    summary = label_summary({"hall": hall, "shed": shed}, splits)  # type: ignore[arg-type]
    everything = summary.overall
    assert (everything[POSITIVE[0]], everything[f"first_{POSITIVE[0]}"]) == (2 / 10, 1 / 10)
    assert (everything[POSITIVE[-1]], everything[f"first_{POSITIVE[-1]}"]) == (5 / 10, 5 / 10)
    cells = " ".join(label_markdown(summary).split("## By the first RANSAC result")[1].split())
    assert "| shed | test | 0.0 | 0.0 | 0.0 | 50.0 |" in cells
    mixed = label_summary({"hall": hall, "shed": SHED}, splits)  # type: ignore[arg-type]
    alone = label_summary({"hall": HALL, "shed": SHED}, splits)  # type: ignore[arg-type]
    assert label_markdown(mixed) == label_markdown(alone)


def test_bands_by_hand(summary) -> None:  # type: ignore[no-untyped-def]
    height = summary.by_height
    np.testing.assert_allclose(height["low"], [0, 0.5, 1, 1.5, 2, 2.5, 3])  # above the lowest of each scene
    np.testing.assert_allclose(height["high"], height["low"] + 0.5)
    assert list(height["n_views"]) == [5, 3, 0, 0, 0, 0, 2]
    np.testing.assert_allclose(height[POSITIVE[0]], [2 / 5, 0, NAN, NAN, NAN, NAN, 0])
    np.testing.assert_allclose(height[POSITIVE[-1]], [4 / 5, 1 / 3, NAN, NAN, NAN, NAN, 0])
    visible = summary.by_visible
    assert list(visible["low"]) == [0, 1, 10, 30, 100, 300, 1000, 3000]
    assert list(visible["n_views"]) == [1, 3, 0, 2, 1, 1, 1, 1]
    np.testing.assert_allclose(visible[POSITIVE[-1]], [0, 0, NAN, 1 / 2, 1, 1, 1, 1])


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return make_dataset(tmp_path / "hut", ("train", "train", "test"), n_locations=5, n_directions=8, n_landmarks=100)


def test_logged_numbers_are_those_of_the_tables(dataset: Dataset, tmp_path: Path) -> None:
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    summary = log_labels(dataset, tracking, {"render": 1.5, "label": 20.0})
    run = newest_run(tracking, "label", {"dataset": "hut"})
    assert run is not None
    params = {"dataset": "hut", "dataset_fingerprint": dataset.fingerprint()}
    assert run.data.params == params | {"scenes": "scene-0 scene-1 scene-2"}
    metrics = run.data.metrics
    shares = summary.shares
    assert (metrics["n_views"], metrics["train_n_views"], metrics["seconds_label"]) == (120, 80, 20.0)
    for name in POSITIVE:
        assert metrics[name] == shares[name].iloc[-1]
        assert metrics[f"train_{name}"] == pytest.approx(shares[name].iloc[:2].mean())
    for name in ("labels.csv", "labels.md", "labels.png"):
        written = (dataset.root / "results" / name).read_bytes()
        assert artifact(tracking, run.info.run_id, name).read_bytes() == written
    pd.testing.assert_frame_equal(pd.read_csv(dataset.root / "results" / "labels.csv"), shares, check_dtype=False)


def test_unlabelled_or_empty_scenes_are_named(dataset: Dataset, tmp_path: Path) -> None:
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    path = dataset.scenes[1].table
    labelled = read_table(path)
    write_table(labelled.assign(status=labelled["status"].where(labelled.index != 3, UNLABELLED)), path)
    with pytest.raises(TableError):
        log_labels(dataset, tracking)
    with pytest.raises(TableError):
        log_labels(replace(dataset, scenes=()), tracking)
    assert not (dataset.root / "results").exists()
