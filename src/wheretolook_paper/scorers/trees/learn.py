"""Boosted trees (LightGBM) on pooled statistics of the visible landmarks: training and score."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightgbm import Booster
from numpy.typing import NDArray
from scipy.special import expit
from sklearn.metrics import average_precision_score, log_loss, roc_auc_score
from tqdm.auto import tqdm

from wheretolook.dataset.layout import Dataset, SceneFolder, views_by_camera
from wheretolook.dataset.viewpoint_table import is_good, poses
from wheretolook.geometry.camera import Camera, camera_of_record
from wheretolook.geometry.poses import Float, check_poses
from wheretolook.inputs.channels import ATTRIBUTES
from wheretolook.inputs.landmark_features import LandmarkDescriber
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scorers.base import BLOCK
from wheretolook.scorers.registry import BuildOptions
from wheretolook.scorers.set.score import LandmarkScorer
from wheretolook.training.data import check_classes, labelled_rows, validation_views
from wheretolook.training.fit import home_device
from wheretolook.training.learner import TrainingJob, TrainingResult, class_counts, fit_platt
from wheretolook.training.provenance import training_scenes
from wheretolook.training.trained_network import TrainingRange, camera_quantities, view_quantities
from wheretolook.training.weights import check_method_of_weights, read_weights, write_weights
from wheretolook.utils.errors import ConfigError, WeightsError
from wheretolook_paper.scorers.pooled_features import POOLED, pool
from wheretolook_paper.scorers.trees import TreesConfig


@dataclass(frozen=True, eq=False)
class BoostedTrees:
    """A LightGBM model of two classes, as its own text, with a calibration of its log-odds."""

    model: str
    camera: Camera | None  # of the training views; None for several
    scale: float = 1.0
    offset: float = 0.0  # calibrated log-odds are scale * sum of the trees + offset
    training_range: TrainingRange | None = None

    @cached_property
    def booster(self) -> Booster:
        """The model."""
        import lightgbm

        return lightgbm.Booster(model_str=self.model)

    def logits(self, pooled: NDArray[Any]) -> Float:
        """Return calibrated log-odds (B,) of views described by `POOLED`, (B, len(POOLED))."""
        return self.scale * self.raw_logits(pooled) + self.offset

    def raw_logits(self, pooled: NDArray[Any]) -> Float:
        """Return log-odds (B,) before calibration."""
        raw = self.booster.predict(np.asarray(pooled, dtype=np.float64), raw_score=True, num_threads=1)
        return np.asarray(raw, dtype=np.float64)

    def save(self, path: Path, training: dict[str, Any] | None = None) -> None:
        """Write one safetensors file atomically, with a record of the training; equal trees give equal bytes."""
        header: dict[str, Any] = {"features": list(POOLED), "scale": self.scale, "offset": self.offset}
        header |= {"camera": None if self.camera is None else self.camera.record(), "training": training or {}}
        if self.training_range is not None:
            header["range"] = self.training_range.record()
        text = np.frombuffer(self.model.encode(), dtype=np.uint8)
        write_weights(path, "trees", {"model": torch.from_numpy(text.copy())}, header)

    @classmethod
    def load(cls, path: str | Path) -> BoostedTrees:
        """Read what `save` wrote; raise a WeightsError if it is missing, damaged or of another method."""
        import lightgbm

        tensors, header = read_weights(Path(path))
        check_method_of_weights(path, header, "trees")
        try:
            if header["features"] != list(POOLED):
                raise ValueError("these trees have other inputs")
            camera = None if header["camera"] is None else camera_of_record(header["camera"])
            known = TrainingRange.of_record(header["range"]) if "range" in header else None
            model = tensors["model"].numpy().tobytes().decode()
            trees = cls(model, camera, float(header["scale"]), float(header["offset"]), known)
            if trees.booster.num_feature() != len(POOLED):
                raise ValueError("these trees have other inputs")
            return trees
        except (KeyError, TypeError, ValueError, AttributeError, ConfigError, lightgbm.basic.LightGBMError) as error:
            raise WeightsError(f"not usable trees: {error}", path=path, fix="Train again.") from error


@dataclass(frozen=True, eq=False)
class PooledViews:
    """Labelled viewpoints described by `POOLED`."""

    values: NDArray[np.float32]  # (B, len(POOLED)) float32
    labels: NDArray[np.bool_]  # (B,) bool, whether the viewpoint localizes
    scene: NDArray[np.int64]  # (B,) int64, number of the scene
    location: NDArray[np.int64]  # (B,) int64, location_id, unique within a scene
    quantities: Float  # (B, 6), see `wheretolook.training.trained_network`

    def only(self, mask: NDArray[np.bool_]) -> PooledViews:
        """Return the views where `mask` (B,) is set."""
        return PooledViews(*(getattr(self, column.name)[mask] for column in fields(self)))


def load_pooled(
    dataset: Dataset, scenes: Sequence[SceneFolder], limits: tuple[float, float], device: str, progress: bool
) -> PooledViews:
    """Describe the labelled viewpoints of scenes; positive are those within limits in metres and degrees.

    Raises a TableError if a scene has no table or no labels, or its occlusion does not fit; a MapError without
    landmarks.
    """
    parts: list[tuple[Any, ...]] = []
    tables = [(scene, labelled_rows(scene)) for scene in scenes]
    total = sum(len(table) for _, table in tables)
    with tqdm(total=total, desc="pool views", unit="view", disable=not progress) as bar:
        for number, (scene, table) in enumerate(tables):
            describer = LandmarkDescriber(scene.localization_map(device=device))
            cam_from_world = poses(table)
            good = is_good(table, *limits)
            location = table["location_id"].to_numpy(np.int64)
            for camera, rows in views_by_camera(scene, table, 4096):  # some million landmarks at a time
                block = cam_from_world[rows]
                described = describer.of_camera(camera).describe(block)
                values = pool(described, block, camera).cpu().numpy()
                quantities = view_quantities(described, described.counts, camera_quantities(camera))
                parts.append((values, good[rows], np.full(len(rows), number), location[rows], quantities))
                bar.update(len(rows))
    return PooledViews(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def learn_trees(task: TrainingJob) -> TrainingResult:
    """Fit boosted trees to a dataset's train scenes; see `fit_trees`.

    Raises a TableError if there is no train scene, no labels, or labels of one class only.
    """
    dataset = task.dataset
    config = task.config
    limits = config.max_error_m, config.max_error_deg
    views = load_pooled(dataset, training_scenes(dataset), limits, home_device(config), task.progress)
    held_out = validation_views(dataset, views.scene, views.location, config)
    train = views.only(~held_out)
    val = views.only(held_out)
    check_classes(dataset, config, train.labels, val.labels)
    trees, metrics = fit_trees(train, val, task.camera, task.options, config.seed)
    trees = replace(trees, training_range=TrainingRange.of(train.quantities))
    return TrainingResult(trees, metrics, class_counts(train=train.labels, val=val.labels))


def fit_trees(
    train: PooledViews, val: PooledViews, camera: Camera | None, config: TreesConfig, seed: int = 0
) -> tuple[BoostedTrees, dict[str, float]]:
    """Boost trees, keep as many as rank the validation views best, and calibrate their sum; return trees and metrics.

    The seed decides which views LightGBM samples to choose bins.
    """
    import lightgbm

    leaves = {"num_leaves": config.max_leaves, "min_data_in_leaf": config.min_leaf, "lambda_l2": config.l2}
    options = {"objective": "binary", "learning_rate": config.learning_rate, **leaves, "seed": seed, "verbosity": -1}
    options |= {"deterministic": True, "force_col_wise": True}  # the same trees for any number of threads
    views = lightgbm.Dataset(train.values.astype(np.float64), train.labels.astype(np.float64))
    booster = lightgbm.train(options, views, config.max_trees)
    every = max(1, config.max_trees // 40)
    values = val.values.astype(np.float64)
    raw = np.zeros(len(val.labels))
    precision: dict[int, float] = {}
    for first in range(0, booster.num_trees(), every):
        raw += np.asarray(booster.predict(values, start_iteration=first, num_iteration=every, raw_score=True))
        precision[min(first + every, booster.num_trees())] = float(average_precision_score(val.labels, raw))
    n_trees = max(precision, key=lambda number: precision[number])
    trees = BoostedTrees(booster.model_to_string(num_iteration=n_trees), camera)
    logits = trees.raw_logits(val.values)
    scale, offset = fit_platt(logits, val.labels)
    trees = replace(trees, scale=scale, offset=offset)
    bce = float(log_loss(val.labels, expit(trees.logits(val.values))))
    auc = float(roc_auc_score(val.labels, logits))
    metrics = {"n_trees": float(n_trees), "val_average_precision": precision[n_trees], "val_roc_auc": auc}
    return trees, {**metrics, "val_bce": bce}


class TreesScorer(LandmarkScorer):
    """Probability that a view localizes, by boosted trees on the positions and attributes of its visible landmarks."""

    name = "trees"

    def __init__(self, localization_map: LocalizationMap, trees: BoostedTrees) -> None:
        super().__init__(localization_map, ATTRIBUTES, trees.training_range, trees.camera)
        self.trees = trees

    def score(self, cam_from_world: Float) -> Float:
        """Return probabilities (B,) in [0, 1]."""
        cam_from_world = check_poses(cam_from_world)
        scores = np.empty(len(cam_from_world))
        quantities: list[Float] = []
        for begin in range(0, len(scores), BLOCK):
            block = cam_from_world[begin : begin + BLOCK]
            described = self.describer.describe(block)
            quantities += self._quantities(described, described.counts)
            pooled = pool(described, block, self.localization_map.camera)
            scores[begin : begin + BLOCK] = expit(self.trees.logits(pooled.cpu().numpy()))
        self._watch.check(self.name, self.training_range, quantities)
        return scores


def build_trees(localization_map: LocalizationMap, options: BuildOptions) -> TreesScorer:
    """Return the scorer of a weights file."""
    assert options.weights is not None
    return TreesScorer(localization_map, BoostedTrees.load(options.weights))
