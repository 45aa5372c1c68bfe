"""Sets of looks joined from stored matches: their labels, the comparison of strategies, and when to stop looking."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from synthetic_dataset import CAMERA, make_scene
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.viewpoint_table import poses, read_table, write_table
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.geometry.poses import pose_error
from wheretolook.localization.confidence import ConfidenceModel, confidence_features
from wheretolook.localization.estimation import PoseEstimator
from wheretolook.localization.joint_labels import SET_COLUMNS, label_sets
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.tracking.config import TrackingConfig
from wheretolook.tracking.runs import newest_run
from wheretolook.utils.errors import ConfigError, PoseError, TableError, WeightsError
from wheretolook.weights.resolve import load_scorer
from wheretolook_paper.commands.look_sets import LookConfig, compare_looks, evaluate_looks
from wheretolook_paper.evaluation.looks import look_table, stopping_table

WEIGHTS = Path(__file__).parents[2] / "data" / "release" / "weights" / "set.safetensors"


def with_matches(scene: SceneFolder, outliers: float = 0.5, seed: int = 0) -> pd.DataFrame:
    """The scene's table with matches of what each view sees, half of them wrong, and the labels that follow."""
    rng = np.random.default_rng(seed)
    table = read_table(scene.table)
    points = Landmarks.load(scene.landmarks).points
    estimator = PoseEstimator(Landmarks.load(scene.landmarks).points)
    rows = []
    inliers = []
    pixels = []
    status = []
    errors = []
    for pose in poses(table):
        there = points @ pose[:, :3].T + pose[:, 3]
        at = CAMERA.project(there)
        seen = np.flatnonzero((there[:, 2] > 0.1) & CAMERA.in_image(at))
        seen = np.sort(rng.choice(seen, min(40, len(seen)), replace=False))
        wrong = rng.random(len(seen)) < outliers
        found = at[seen] + rng.normal(0, 0.3, (len(seen), 2))
        found[wrong] = rng.uniform((0, 0), (160, 120), (int(wrong.sum()), 2))
        estimate = estimator.estimate(found.astype(np.float32), seen, CAMERA) if len(seen) >= 4 else None
        kept = seen[:0] if estimate is None else seen[estimate[1]]
        rows.append(seen.astype(np.int32))
        inliers.append(kept.astype(np.int32))
        pixels.append(found.astype(np.float32).ravel())
        few = "too_few_matches" if len(seen) < 4 else "no_pose"
        status.append("localized" if len(kept) >= 10 else few)
        errors.append((np.nan, np.nan) if estimate is None else pose_error(estimate[0], pose))
    labels = {"matched_rows": rows, "inlier_rows": inliers, "matched_pixels": pixels, "status": status}
    error_m, error_deg = np.array(errors, dtype=np.float32).T
    return table.assign(**labels, error_m=error_m, error_deg=error_deg, n_inliers=[len(kept) for kept in inliers])


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    root = tmp_path_factory.mktemp("data") / "tiny"
    scene = make_scene(root / "one", "test", 0, n_locations=6, n_directions=16, n_landmarks=600)
    write_table(with_matches(scene).astype({"n_inliers": np.int32}), scene.table)
    made = Dataset(root, (scene,))
    made.save()
    return made


@pytest.fixture(scope="module")
def table(dataset: Dataset) -> pd.DataFrame:
    return read_table(dataset.scenes[0].table, pixels=True)


@pytest.fixture(scope="module")
def points(dataset: Dataset) -> np.ndarray:
    return Landmarks.load(dataset.scenes[0].landmarks).points


def test_a_set_of_one_has_the_label_of_its_view(table: pd.DataFrame, points: np.ndarray) -> None:
    rows = np.flatnonzero(table["n_inliers"] > 0)[:20]
    labelled = label_sets(table, rows[:, None], points, CAMERA)
    assert list(labelled.columns) == list(SET_COLUMNS)
    for name in ("status", "n_inliers", "location_id"):
        assert list(labelled[name]) == list(table[name].to_numpy()[rows])
    np.testing.assert_allclose(labelled["error_m"], table["error_m"].to_numpy()[rows], rtol=1e-3)


def test_sets_localize_where_their_looks_do_not(table: pd.DataFrame, points: np.ndarray) -> None:
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
    noisy = label_sets(table, sets[:1], points, CAMERA, turn_noise_deg=0.5)
    again = label_sets(table, sets[:1], points, CAMERA, turn_noise_deg=0.5)
    np.testing.assert_array_equal(noisy["error_m"], again["error_m"])
    assert noisy["error_m"].max() < 0.2 and not np.allclose(noisy["error_m"], labelled["error_m"][:1], rtol=1e-3)


def test_what_cannot_be_joined_is_refused(table: pd.DataFrame, points: np.ndarray) -> None:
    first = np.flatnonzero(table["location_id"] == 0)
    other = np.flatnonzero(table["location_id"] == 1)
    with pytest.raises(PoseError):
        label_sets(table, [[first[0], other[0]]], points, CAMERA)
    with pytest.raises(TableError):
        label_sets(table.drop(columns="matched_pixels"), [[0]], points, CAMERA)
    for rows in ([], [len(table)], [-1]):
        with pytest.raises(TableError):
            label_sets(table, [rows], points, CAMERA)
    seen = int(np.flatnonzero(table["n_inliers"] > 0)[0])
    with pytest.raises(TableError):
        label_sets(table, [[seen]], points[:3], CAMERA)
    damaged = table.copy()
    damaged.at[seen, "matched_pixels"] = np.zeros(3, dtype=np.float32)
    with pytest.raises(TableError):
        label_sets(damaged, [[seen]], points, CAMERA)
    with pytest.raises(ConfigError):
        label_sets(table, [[seen]], points, CAMERA, turn_noise_deg=-1)


def test_strategies_are_compared_and_logged(dataset: Dataset, tmp_path: Path) -> None:
    tracking = TrackingConfig(tmp_path / "mlruns")
    config = LookConfig(numbers=(1, 3), strategies=("together", "in-turn", "one-by-one", "even", "fisher"))
    found = evaluate_looks(dataset, EvaluateConfig(weights=(WEIGHTS,)), tracking, config, progress=False)
    assert found is not None and len(found) == 10
    good = found.set_index(["strategy", "n_looks"])
    ones = good.loc[[(name, 1) for name in ("together", "in-turn", "one-by-one", "even")]]
    assert (ones["gain"] == 0).all() and ones["good"].nunique() == 1
    assert (good.loc[("together", 3), "good"]) >= ones["good"].iloc[0]
    assert (found["good_low"] <= found["good"]).all() and (found["good"] <= found["good_high"]).all()
    lines = (dataset.root / "results" / "looks.md").read_text().splitlines()
    assert sum(line.startswith("| together") for line in lines) == 2 and "## When to stop" in lines
    assert newest_run(tracking, "looks") is not None
    pd.testing.assert_frame_equal(pd.read_csv(dataset.root / "results" / "looks.csv"), found, check_dtype=False)


def test_without_pixels_nothing_is_compared(tmp_path: Path) -> None:
    scene = make_scene(tmp_path / "tiny" / "one", "test", 0, n_locations=2)
    bare = Dataset(tmp_path / "tiny", (scene,))
    options = EvaluateConfig(weights=(WEIGHTS,))
    assert evaluate_looks(bare, options, TrackingConfig(tmp_path / "mlruns")) is None
    with pytest.raises(TableError):
        compare_looks(scene, load_scorer(str(WEIGHTS), scene.localization_map()), progress=False)


def test_one_stops_when_sure_enough() -> None:
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


def test_confidence_rises_with_inliers_and_falls_with_a_rival(tmp_path: Path) -> None:
    model = ConfidenceModel.bundled()

    def confidence(*numbers: float) -> float:
        return float(model.predict_proba(confidence_features(*numbers)))

    plain = confidence(100, 200, 10, 40, 2, 0.1)
    assert confidence(300, 400, 10, 150, 2, 0.05) > plain > confidence(100, 200, 90, 40, 30, 1.0)
    features = confidence_features([99], [200], [0], [30], [10], [np.inf])
    np.testing.assert_allclose(features[0], [0, np.log(99.5 / 201), np.log(2), np.log(10)])
    (tmp_path / "confidence.json").write_text('{"weights": {"log_inliers": 1}, "bias": 0}')
    with pytest.raises(WeightsError):
        ConfidenceModel.load(tmp_path / "confidence.json")
