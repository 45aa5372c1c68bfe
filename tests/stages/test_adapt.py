"""The adapt stage, from labels that are there to weights that score."""

import numpy as np
import pandas as pd
import pytest

from fixed_fields import main
from stages.test_pipeline import EXPERIMENT
from synthetic_dataset import make_dataset
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_files import write_table
from wheretolook.dataset.viewpoint_table import is_good, poses
from wheretolook.evaluation.adaptation import compare_log_odds
from wheretolook.scorers.weights import load_scorer
from wheretolook.tracking import TrackingConfig, finished_runs
from wheretolook.training.weights import read_training


@pytest.fixture
def dataset(tmp_path):
    """Two labelled scenes of weak landmarks, of which the weights that ship expect other labels than they have."""
    dataset = make_dataset(tmp_path / "data" / "tiny", ("train", "test"))
    for scene in dataset.scenes:
        scene.stage_cache("label", "key").store()
    return dataset


def run(dataset, *options):
    root = dataset.root
    camera = ["--camera.width", "160", "--camera.height", "120", "--camera.focal_px", "80", "--camera.fov_deg", "null"]
    where = ["--name", root.name, "--data", str(root.parent), "--tracking.folder", str(root.parent / "mlruns")]
    return main(["adapt", *where, "--device", "cpu", *camera, *options])


def test_adapted_weights_have_a_lower_loss_and_are_logged(dataset, capsys):
    shards = dataset.scenes[1].adapt_shards / "000000"
    shards.mkdir(parents=True)  # of a run before these views had labels
    assert run(dataset, "--scene", "scene-1") == 0
    assert not shards.parent.exists()
    path = dataset.root / "adapted" / "scene-1.safetensors"
    assert "the adapted weights are better" in capsys.readouterr().out and path.with_suffix(".md").is_file()
    scene = dataset.scenes[1]
    localization_map = scene.localization_map(scene.camera, "cpu")
    table = scene.read_table()
    good = is_good(table)
    losses = []
    for weights in (None, path):
        probability = load_scorer(localization_map, weights).score(poses(table)).clip(1e-9, 1 - 1e-9)
        losses.append(-np.log(np.where(good, probability, 1 - probability)).mean())
    assert losses[1] < losses[0]
    training = read_training(path)
    assert training["after"]["log_loss"] < training["before"]["log_loss"]
    tracking = TrackingConfig(dataset.root.parent / "mlruns")
    (one,) = finished_runs(tracking, "adapt")
    assert one.data.metrics["better"] == 1.0


def test_weights_without_a_gain_are_not_kept(dataset, capsys):
    scene = dataset.scenes[1]
    table = scene.read_table()
    scored = load_scorer(scene.localization_map(scene.camera)).score(poses(table))
    draws = np.random.default_rng(5).random(len(table))
    localized = draws < scored  # the scorer is right
    table["status"] = np.where(localized, "localized", "no_pose")
    table["error_m"] = np.where(localized, 0.01, np.nan).astype(np.float32)
    table["error_deg"] = np.where(localized, 0.1, np.nan).astype(np.float32)
    assert min(localized.sum(), (~localized).sum()) >= 10  # else there is nothing to learn from
    write_table(table, scene.table)
    path = dataset.root / "adapted" / "scene-1.safetensors"
    path.parent.mkdir()
    path.write_text("of before")
    assert run(dataset, "--scene", "scene-1") == 0
    assert "does not make the weights better" in capsys.readouterr().out and not path.exists()


@pytest.mark.parametrize(
    "options",
    [
        (),
        ("--scene", "house"),
        ("--scene", "scene-1", "--minutes", "0"),
        ("--scene", "scene-1", "--out", "dataset/x.safetensors"),
        ("--scene", "scene-1", "--weights", "x.safetensors", "--out", "x.safetensors"),
        ("--scene", "scene-1", "--weights", "nowhere.safetensors"),
        ("--map", "dataset", "--label.appearance", "0.5"),
        ("--scene", "scene-1", "--label.changes", "0.5"),
    ],
)
def test_bad_input_is_named(dataset, options, capsys, monkeypatch):
    monkeypatch.chdir(dataset.root)
    (dataset.root / "dataset").write_text("")
    assert run(dataset, *options) == 2
    assert capsys.readouterr().err.startswith("wheretolook: error: ")


def test_gains_are_those_of_known_cases():
    """Two locations of two views: the first chooses wrongly before and rightly after."""
    good = np.array([True, False, True, False])
    before = np.array([-1.0, 1.0, 1.0, -1.0])
    after = np.array([2.0, -2.0, 2.0, -2.0])
    centers = np.array([[0.0, 0, 0], [0, 0, 0], [9, 0, 0], [9, 0, 0]])
    gain = compare_log_odds(before, after, good, np.array([4, 4, 7, 7]), centers)
    assert gain.before["regret"] == 50 and gain.after["regret"] == 0
    assert gain.before["auc"] == 0.5 and gain.after["auc"] == 1
    expected = (np.log1p(np.exp(1)) + np.log1p(np.exp(-1))) / 2 - np.log1p(np.exp(-2))
    assert gain.log_loss_less[0] == pytest.approx(expected) and gain.regret_less[0] == 50


@pytest.mark.slow
def test_views_are_labelled_for_some_minutes_and_found_again(tmp_path, capsys):
    """From nothing: a small apartment is made, mapped and sampled; then adapt labels, stops, and goes on."""
    settings = tmp_path / "tiny.yaml"
    only_test = EXPERIMENT.replace("train: 1", "train: 0")
    settings.write_text(
        only_test.replace("max_locations: 8, max_directions: 5", "max_locations: 40, max_directions: 8")
    )
    where = ["--config", str(settings), "--data", str(tmp_path / "data"), "--device", "cpu"]
    where += ["--tracking.folder", str(tmp_path / "mlruns")]
    for stage in ("scenes", "map", "sample"):
        assert main([stage, *where]) == 0
    (scene,) = Dataset.load(tmp_path / "data" / "tiny").scenes
    n_views = len(scene.read_table())
    assert n_views > 128  # the clock is looked at after so many
    capsys.readouterr()
    assert main(["adapt", *where, "--minutes", "0.0001"]) == 0
    said = capsys.readouterr().out
    assert f"128 of {n_views} views labelled" in said and "fitting to 128" in said
    made = {path: path.stat().st_mtime_ns for path in scene.folder.glob("adapt-shards/*/*.parquet")}
    assert sum(len(pd.read_parquet(path)) for path in made) >= 128
    assert main(["adapt", *where]) == 0
    said = capsys.readouterr().out
    assert f"fitting to {n_views} rendered views" in said
    assert made == {path: path.stat().st_mtime_ns for path in made}  # nothing was labelled twice
