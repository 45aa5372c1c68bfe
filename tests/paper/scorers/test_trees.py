"""Boosted trees: fitting, calibration, the weights file, and the score of views."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expit

from learning_options import train_config
from synthetic_dataset import CAMERA, make_dataset
from wheretolook.commands.train import train_methods as train
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_table import is_good, poses
from wheretolook.scorers.weights import load_scorer
from wheretolook.tracking import TrackingConfig
from wheretolook.training.weights import method_of_weights, read_training
from wheretolook.utils.errors import ConfigError
from wheretolook_paper.scorers.pooled_features import POOLED
from wheretolook_paper.scorers.trees import TreesConfig
from wheretolook_paper.scorers.trees.learn import BoostedTrees, PooledViews, fit_trees, load_pooled

FEW = TreesConfig(max_trees=20, max_leaves=7, min_leaf=5)


def some_views(n, seed):
    """Views whose label follows two statistics, one of them sometimes unknown."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(n, len(POOLED))).astype(np.float32)
    labels = values[:, 0] + 2 * np.maximum(values[:, 7], 0) + 0.5 * rng.normal(size=n) > 0.5
    values[rng.random(n) < 0.2, 7] = np.nan
    return PooledViews(values, labels, np.zeros(n, int), np.arange(n), np.zeros((n, 6)))


@pytest.fixture(scope="module")
def trees():
    return fit_trees(some_views(3000, 0), some_views(1000, 1), CAMERA, FEW)[0]


def test_the_number_of_trees_and_the_calibration_follow_the_validation_views():
    val = some_views(1000, 1)
    config = TreesConfig(max_trees=200, max_leaves=31, min_leaf=1, learning_rate=0.3)
    trees, metrics = fit_trees(some_views(400, 6), val, CAMERA, config)
    assert metrics["n_trees"] == trees.booster.num_trees() < 200  # more would overfit
    assert expit(trees.logits(val.values)).mean() == pytest.approx(val.labels.mean(), abs=1e-3)


def test_weights_come_back_and_equal_seeds_give_equal_bytes(trees, tmp_path):
    path = tmp_path / "weights" / "trees.safetensors"
    trees.save(path, {"method": "trees"})
    values = some_views(300, 2).values
    np.testing.assert_array_equal(BoostedTrees.load(path).logits(values), trees.logits(values))
    assert method_of_weights(path) == "trees" and read_training(path) == {"method": "trees"}
    again = fit_trees(some_views(3000, 0), some_views(1000, 1), CAMERA, FEW)[0]
    again.save(tmp_path / "again", {"method": "trees"})
    assert path.read_bytes() == (tmp_path / "again").read_bytes()


def test_the_scorer_is_the_trees_on_pooled_views(tmp_path):
    dataset = make_dataset(tmp_path / "tiny", ("train", "val"), n_locations=10, n_directions=12)
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    (model,) = train(dataset, train_config("trees", accelerator="cpu", trees=FEW), tracking, progress=False)
    scene = dataset.scenes[1]
    localization_map = scene.localization_map(dataset.camera)
    scorer = load_scorer(localization_map, model.path)
    views = load_pooled(Dataset(dataset.root, (scene,)), [scene], (0.05, 0.4), "cpu", False)
    table = scene.read_table()
    np.testing.assert_array_equal(views.labels, is_good(table))
    logits = BoostedTrees.load(model.path).logits(views.values)
    np.testing.assert_allclose(scorer.score(poses(table)), expit(logits), rtol=1e-6)
    wide = localization_map.of_camera(replace(dataset.camera, focal_px=dataset.camera.focal_px / 2))
    assert scorer.in_range(poses(table)).mean() > 0.9
    assert not load_scorer(wide, model.path).in_range(poses(table)).any()


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("conv", {"widths": ()}),
        ("conv", {"dropout": 1.0}),
        ("sphere", {"width": 30, "heads": 4}),
        ("trees", {"max_leaves": 1}),
    ],
)
def test_invalid_options(name, options):
    with pytest.raises(ConfigError):
        train_config(**{name: options})
