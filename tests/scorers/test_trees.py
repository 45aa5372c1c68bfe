"""Boosted trees: the same numbers as LightGBM's, on disk and back, trained and evaluated as any other method."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import lightgbm
import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from learning_options import changed, train_config
from synthetic_dataset import CAMERA, make_dataset
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_table import is_good, poses
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.scorers.mlp.network import ViewpointNetwork
from wheretolook.scorers.registry import make_scorer
from wheretolook.stages.evaluate import evaluate_methods as evaluate
from wheretolook.stages.train import train_methods as train
from wheretolook.tracking.config import TrackingConfig
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.training.weights import METADATA_KEY, method_of_weights, read_training
from wheretolook.utils.errors import ConfigError, OutOfRangeWarning, WeightsError
from wheretolook.weights.resolve import load_scorer
from wheretolook_paper.scorers.pooled_features import POOLED
from wheretolook_paper.scorers.trees.config import TreesConfig
from wheretolook_paper.scorers.trees.learn import BoostedTrees, PooledViews, fit_trees, load_pooled
from wheretolook_paper.scorers.trees.score import TreesScorer

pytestmark = pytest.mark.usefixtures("no_pictures")

FEW = TreesConfig(max_trees=20, max_leaves=7, min_leaf=5)


def some_views(n: int, seed: int) -> PooledViews:
    """Views whose label follows two statistics, one of them unknown now and then."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(n, len(POOLED))).astype(np.float32)
    labels = values[:, 0] + 2 * np.maximum(values[:, 7], 0) + 0.5 * rng.normal(size=n) > 0.5
    values[rng.random(n) < 0.2, 7] = np.nan
    return PooledViews(values, labels, np.zeros(n, int), np.arange(n))


@pytest.fixture(scope="module")
def trees() -> BoostedTrees:
    return fit_trees(some_views(3000, 0), some_views(1000, 1), CAMERA, FEW)[0]


def test_trees_are_lightgbms() -> None:
    """To the last digits, also where a value is unknown that was, or was not, in training, zero, or a threshold."""
    views = some_views(2000, 0)
    others = some_views(500, 1)
    data = lightgbm.Dataset(views.values.astype(np.float64), views.labels.astype(np.float64))
    model = lightgbm.train({"objective": "binary", "verbosity": -1, "num_threads": 1}, data, 30)
    rng = np.random.default_rng(2)
    others.values[rng.random(others.values.shape) < 0.1] = np.nan
    others.values[rng.random(others.values.shape) < 0.1] = 0
    for n_trees in (1, 17, 30):
        found = BoostedTrees.of_lightgbm(model, CAMERA, n_trees)
        assert len(found.roots) == n_trees and found.depth > 3
        splits = found.left != torch.arange(len(found.left))
        for column in found.feature[splits].unique():
            thresholds = found.threshold[splits & (found.feature == column)]
            thresholds = thresholds[thresholds.abs() > 1e-30]  # what is smaller LightGBM takes for zero
            others.values[: len(thresholds), column] = thresholds[: len(others.values)]
        raw = model.predict(others.values.astype(np.float64), num_iteration=n_trees, raw_score=True)
        np.testing.assert_allclose(found.raw_logits(torch.from_numpy(others.values)), raw, rtol=0, atol=1e-12)


def test_trees_of_one_leaf() -> None:
    """Where nothing can be told apart, LightGBM stops early."""
    views = some_views(40, 0)
    trees, metrics = fit_trees(views, some_views(40, 1), CAMERA, TreesConfig(max_trees=50, min_leaf=30))
    assert metrics["n_trees"] == len(trees.roots) == 1 and trees.depth == 0
    logits = trees.raw_logits(torch.from_numpy(views.values))
    share = float(views.labels.mean())
    np.testing.assert_allclose(logits, np.log(share / (1 - share)), atol=1e-6)


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("first", "second"):
        fit_trees(some_views(3000, 0), some_views(500, 1), CAMERA, FEW, seed=3)[0].save(tmp_path / name)
    assert (tmp_path / "first").read_bytes() == (tmp_path / "second").read_bytes()


def test_weights_of_earlier_trees_score_as_they_did(trees: BoostedTrees, tmp_path: Path) -> None:
    """Those of scikit-learn have log-odds of their own beside the trees."""
    replace(trees, baseline=-0.75).save(tmp_path / "trees.safetensors")
    views = torch.from_numpy(some_views(50, 2).values)
    found = BoostedTrees.load(tmp_path / "trees.safetensors")
    torch.testing.assert_close(found.raw_logits(views), trees.raw_logits(views) - 0.75)


def test_as_many_trees_are_kept_as_order_the_other_views_best() -> None:
    train_views = some_views(400, 6)
    val = some_views(1000, 1)
    config = TreesConfig(max_trees=200, max_leaves=31, min_leaf=1, learning_rate=0.3)
    trees, metrics = fit_trees(train_views, val, CAMERA, config)
    assert metrics["n_trees"] == len(trees.roots) < 200  # so many would have learnt by heart
    assert metrics["val_roc_auc"] > 0.85
    probability = trees.logits(torch.from_numpy(val.values)).sigmoid().numpy()
    assert probability.mean() == pytest.approx(val.labels.mean(), abs=1e-3)  # calibrated
    assert (
        fit_trees(train_views, val, CAMERA, config)[0]
        .raw_logits(torch.from_numpy(val.values))
        .equal(trees.raw_logits(torch.from_numpy(val.values)))
    )


def test_a_statistic_that_is_never_known_is_not_asked_for() -> None:
    train_views = some_views(400, 0)
    val = some_views(200, 1)
    train_views.values[:, 11] = np.nan
    trees, _ = fit_trees(train_views, val, CAMERA, FEW)
    assert 11 not in trees.feature[trees.left != torch.arange(len(trees.left))]
    assert torch.isfinite(trees.logits(torch.from_numpy(val.values))).all()


def test_trees_come_back_from_disk(trees: BoostedTrees, tmp_path: Path) -> None:
    path = tmp_path / "weights" / "trees.safetensors"
    trees.save(path, {"method": "trees"})
    views = torch.from_numpy(some_views(300, 2).values)
    torch.testing.assert_close(BoostedTrees.load(path).logits(views), trees.logits(views), rtol=0, atol=0)
    content = path.read_bytes()
    BoostedTrees.load(path).save(path, {"method": "trees"})
    assert path.read_bytes() == content
    assert method_of_weights(path) == "trees" and read_training(path) == {"method": "trees"}
    with pytest.raises(WeightsError, match=r"trees.safetensors.*not of mlp"):
        TrainedNetwork.load(path, ViewpointNetwork, "mlp-2d")


def test_damaged_trees_are_named(trees: BoostedTrees, tmp_path: Path) -> None:
    path = tmp_path / "trees.safetensors"
    trees.save(path)
    arrays = load_file(path)
    header = {"format_version": 1, "kind": "trees", "features": list(POOLED), "camera": vars(CAMERA),
              "depth": trees.depth, "baseline": 0.0, "scale": 1.0, "offset": 0.0}  # fmt: skip
    for wrong, other, message in (
        ({"left": np.full_like(arrays["left"], 10**6)}, {}, "lead out of"),
        ({"value": arrays["value"][:-1]}, {}, "lead out of"),
        ({"feature": np.full_like(arrays["feature"], 200)}, {}, "lead out of"),
        ({}, {"features": ["height"]}, "other statistics"),
        ({}, {"kind": "mlp"}, "not of trees"),
        ({}, {"camera": {"width": 3}}, "damaged description"),
    ):
        save_file({**arrays, **wrong}, path, metadata={METADATA_KEY: json.dumps({**header, **other})})
        if other.get("camera"):
            header_of_camera = {**header, "camera": {"breadth": 3}}
            save_file(arrays, path, metadata={METADATA_KEY: json.dumps(header_of_camera)})
        with pytest.raises(WeightsError, match=message) as error:
            BoostedTrees.load(path)
        assert str(path) in str(error.value)


@pytest.mark.parametrize("wrong", [{"max_trees": 0}, {"max_leaves": 1}, {"min_leaf": 0}, {"learning_rate": 0.0}])
def test_options_that_are_none(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="trees need"):
        TreesConfig(**wrong)  # type: ignore[arg-type]


@pytest.mark.slow
def test_trees_are_trained_and_evaluated(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path / "tiny", ("train", "train", "test", "val"), n_locations=14, n_directions=16)
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    config = train_config("trees", "mlp-2d", epochs=2, hidden=(16,), accelerator="cpu", trees=FEW)
    trees, network = train(dataset, config, tracking, progress=False)
    assert trees.path == dataset.root / "weights" / "trees.safetensors"
    again = train(dataset, changed(config, learning_rate=0.5, epochs=3), tracking, progress=False)
    assert again[0].reused and not again[1].reused  # a network's options do not matter to trees
    assert not train(dataset, changed(config, trees=replace(FEW, l2=3.0)), tracking, progress=False)[0].reused

    methods = ("visible", "trees", "mlp")
    table = evaluate(dataset, EvaluateConfig(methods, resamples=50), tracking, progress=False)
    rows = table[(table["scene"] == "all") & (table["top_n"] == 1)].set_index("method")
    assert rows.loc["trees", "roc_auc"] > 0.9 and 0 <= rows.loc["trees", "ece"] < 0.5
    assert {*rows.index} == {"visible", "trees", "mlp-2d", "oracle"}
    named = evaluate(
        dataset,
        EvaluateConfig(("visible", "trees"), (trees.path, network.path), resamples=50),
        tracking,
        progress=False,
    )
    assert {*named["method"]} == {"visible", "trees", "oracle"}
    assert (named["reference"] == "trees").all()
    trees.path.unlink()
    assert "trees" not in {*evaluate(dataset, EvaluateConfig(resamples=50), tracking, progress=False)["method"]}
    with pytest.raises(WeightsError, match="no weights of trees"):
        evaluate(dataset, EvaluateConfig(methods), tracking, progress=False)


def test_the_scorer_is_the_trees_on_pooled_views(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path / "tiny", ("train", "val"), n_locations=10, n_directions=12)
    tracking = TrackingConfig(str(tmp_path / "mlruns"))
    (model,) = train(dataset, train_config("trees", accelerator="cpu", trees=FEW), tracking, progress=False)
    scene = dataset.scenes[1]
    localization_map = scene.localization_map(dataset.camera)
    scorer = load_scorer(model.path, localization_map)
    assert isinstance(scorer, TreesScorer) and scorer.name == "trees"
    views = load_pooled(Dataset(dataset.root, (scene,)), [scene], (0.05, 0.4), progress=False)
    table = scene.read_table()
    np.testing.assert_array_equal(views.labels, is_good(table))
    scores = scorer.score(poses(table))
    logits = BoostedTrees.load(model.path).logits(torch.from_numpy(views.values))
    np.testing.assert_allclose(scores, logits.sigmoid(), rtol=1e-6)
    with pytest.raises(WeightsError, match="not of mlp"):
        make_scorer("mlp", localization_map, weights=model.path)
    wide = localization_map.of_camera(replace(dataset.camera, focal_px=dataset.camera.focal_px / 2))
    other = load_scorer(model.path, wide)
    assert scorer.in_range(poses(table)).mean() > 0.9 and not other.in_range(poses(table)).any()
    with pytest.warns(OutOfRangeWarning, match="field of view"):
        assert other.score(poses(table)).mean() != scores.mean()  # they serve every camera
