"""Boosted trees on pooled statistics of the landmarks in view: the strong simple learner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm.auto import tqdm

from wheretolook.dataset.layout import Dataset, SceneFolder, views_by_camera
from wheretolook.dataset.viewpoint_table import is_good, poses
from wheretolook.geometry.camera import Camera, camera_of_record
from wheretolook.geometry.poses import Float
from wheretolook.inputs.landmark_features import LandmarkDescriber
from wheretolook.training.data import check_classes, labelled_rows, validation_views
from wheretolook.training.fit import home_device
from wheretolook.training.learner import Learnt, Task, class_counts, fit_platt
from wheretolook.training.scenes import training_scenes
from wheretolook.training.training_range import QUANTITIES, TrainingRange, camera_quantities, view_quantities
from wheretolook.training.weights import check_method_of_weights, read_weights, write_weights
from wheretolook.utils.errors import ConfigError, WeightsError
from wheretolook_paper.scorers.pooled_features import POOLED, pool
from wheretolook_paper.scorers.trees.config import TreesConfig

if TYPE_CHECKING:
    from lightgbm import Booster

BLOCK = 4096  # views described at a time: some million landmarks


@dataclass(frozen=True, eq=False)
class BoostedTrees:
    """T trees of M nodes in all, as arrays."""

    camera: Camera | None  # whose views they have learnt from; None for several
    roots: Tensor  # (T,) int64, node of each tree's root
    feature: Tensor  # (M,) int64, which of `POOLED` a node asks for
    threshold: Tensor  # (M,) float64; values up to it go left
    missing_left: Tensor  # (M,) bool, whether a value that is not known goes left
    left: Tensor  # left, right: (M,) int64, next nodes; a leaf's are itself
    right: Tensor
    value: Tensor  # (M,) float64, of leaves, zero elsewhere
    depth: int  # steps from a root to the deepest leaf
    baseline: float  # log-odds to add to the sum of the trees: 0 of LightGBM's, whose first tree has it in its leaves
    scale: float = 1.0  # scale, offset: what turns the sum into calibrated log-odds: scale * sum + offset
    offset: float = 0.0
    training_range: TrainingRange | None = None  # what the training views were like, if that is known

    @classmethod
    def of_lightgbm(cls, booster: Booster, camera: Camera | None, n_trees: int) -> BoostedTrees:
        """The first trees of a model of two classes that LightGBM has fitted."""
        nodes = [tree["tree_structure"] for tree in booster.dump_model(num_iteration=n_trees)["tree_info"]]
        parts: dict[str, list[Any]] = {name: [] for name in _ARRAYS} | {"roots": list(range(len(nodes)))}
        depths = [0] * len(nodes)
        for number, node in enumerate(nodes):  # which grows while it is gone through: all roots, their children, ...
            is_leaf = "split_feature" not in node
            threshold = 0.0 if is_leaf else node["threshold"]
            parts["feature"].append(0 if is_leaf else node["split_feature"])
            parts["threshold"].append(threshold)
            # where all values were known in training, LightGBM takes one that is not for zero
            as_zero = is_leaf or node["missing_type"] != "NaN"
            parts["missing_left"].append(threshold >= 0 if as_zero else node["default_left"])
            parts["left"].append(number if is_leaf else len(nodes))
            parts["right"].append(number if is_leaf else len(nodes) + 1)
            parts["value"].append(node["leaf_value"] if is_leaf else 0.0)
            if not is_leaf:
                nodes += [node["left_child"], node["right_child"]]
                depths += [depths[number] + 1] * 2
        kinds = {"threshold": torch.float64, "value": torch.float64, "missing_left": torch.bool}
        arrays: dict[str, Any] = {
            name: torch.tensor(part, dtype=kinds.get(name, torch.int64)) for name, part in parts.items()
        }
        return cls(camera, **arrays, depth=max(depths), baseline=0.0)

    def to(self, device: str) -> BoostedTrees:
        """The same trees on a device."""
        return replace(self, **{name: getattr(self, name).to(device) for name in _ARRAYS})

    def logits(self, pooled: Tensor) -> Tensor:
        """Calibrated log-odds (B,) float64 of views described by `POOLED`, (B, len(POOLED)), on the trees' device."""
        return self.scale * self.raw_logits(pooled) + self.offset

    def raw_logits(self, pooled: Tensor) -> Tensor:
        """Log-odds before calibration, (B,) float64: the sum of the trees."""
        pooled = pooled.double()
        nodes = self.roots.expand(len(pooled), -1)
        for _ in range(self.depth):
            values = pooled.gather(1, self.feature[nodes])
            goes_left = torch.where(values.isnan(), self.missing_left[nodes], values <= self.threshold[nodes])
            nodes = torch.where(goes_left, self.left[nodes], self.right[nodes])
        return self.value[nodes].sum(1) + self.baseline

    def save(self, path: Path, training: dict[str, Any] | None = None) -> None:
        """Write one safetensors file, atomically, with JSON values on the training; the same trees, the same bytes."""
        header: dict[str, Any] = {"features": list(POOLED)}
        header |= {"camera": None if self.camera is None else self.camera.record()}
        if self.training_range is not None:
            header["range"] = self.training_range.record()
        header |= {**{name: getattr(self, name) for name in _NUMBERS}, "training": training or {}}
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        arrays |= {name: arrays[name].int() for name in ("roots", "left", "right")}
        arrays |= {name: arrays[name].to(torch.uint8) for name in ("feature", "missing_left")}
        write_weights(path, "trees", arrays, header)

    @classmethod
    def load(cls, path: str | Path) -> BoostedTrees:
        """Read what `save` wrote; a WeightsError if it is missing, damaged, foreign or of another kind."""
        tensors, header = read_weights(Path(path))
        check_method_of_weights(path, header, "trees")
        fix = "Train again, or give weights of trees."
        try:
            features = torch.tensor([POOLED.index(name) for name in header["features"]])
        except (KeyError, TypeError, ValueError) as error:
            problem = f"these trees ask for other statistics of a view: {error}"
            raise WeightsError(problem, path=path, fix=fix) from error
        try:
            numbers: dict[str, Any] = {name: float(header[name]) for name in _NUMBERS}
            if not all(map(isfinite, numbers.values())) or not 0 <= numbers["depth"] <= len(tensors["value"]):
                raise ValueError(f"numbers out of range: {numbers}")
            camera = None if header["camera"] is None else camera_of_record(header["camera"])
            known = TrainingRange.of_record(header["range"]) if "range" in header else None
            arrays = {name: tensors[name] for name in _ARRAYS}
        except (KeyError, TypeError, ValueError, IndexError, AttributeError, ConfigError) as error:
            raise WeightsError(f"damaged description of trees: {error}", path=path, fix=fix) from error
        if any(array.ndim != 1 for array in arrays.values()):
            raise WeightsError("the trees are no lists of nodes", path=path, fix=fix)
        arrays |= {name: arrays[name].long() for name in ("roots", "feature", "left", "right")}
        arrays["missing_left"] = arrays["missing_left"].bool()
        n_nodes = len(arrays["value"])
        bounds = {"roots": n_nodes, "left": n_nodes, "right": n_nodes, "feature": len(features)}
        inside = all(bool(((arrays[name] >= 0) & (arrays[name] < bound)).all()) for name, bound in bounds.items())
        if not inside or len({len(arrays[name]) for name in _ARRAYS if name != "roots"}) != 1:
            raise WeightsError("the trees lead out of their own arrays", path=path, fix=fix)
        arrays["feature"] = features[arrays["feature"]]  # statistics may have come since, or stand in another order
        depth = int(numbers.pop("depth"))
        return cls(camera, **arrays, depth=depth, **numbers, training_range=known)


_ARRAYS = ("roots", "feature", "threshold", "missing_left", "left", "right", "value")
_NUMBERS = ("depth", "baseline", "scale", "offset")


@dataclass(frozen=True, eq=False)
class PooledViews:
    """Labelled viewpoints described by `POOLED`."""

    values: NDArray[np.float32]  # (B, len(POOLED)) float32
    labels: NDArray[np.bool_]  # (B,) bool, whether the viewpoint localizes
    scene: NDArray[np.int64]  # (B,) int64, number of each view's scene in the order given
    location: NDArray[np.int64]  # (B,) int64, location_id of each view, unique only within its scene

    quantities: Float = field(default_factory=lambda: np.empty((0, len(QUANTITIES))))  # (B, 6); none if not known

    def only(self, mask: NDArray[np.bool_]) -> PooledViews:
        """The views where `mask` (B,) is set."""
        quantities = self.quantities[mask] if len(self.quantities) else self.quantities
        return PooledViews(self.values[mask], self.labels[mask], self.scene[mask], self.location[mask], quantities)


def load_pooled(
    dataset: Dataset,
    scenes: Sequence[SceneFolder],
    limits: tuple[float, float],
    device: str = "cpu",
    progress: bool = True,
) -> PooledViews:
    """Describe the labelled viewpoints of some scenes, positive within these limits in metres and degrees.

    Raises a TableError if a scene has no table or no labelled viewpoint, or its occlusion does not fit; a MapError if
    it has no landmarks.
    """
    values: list[NDArray[np.float32]] = []
    labels: list[NDArray[np.bool_]] = []
    location: list[NDArray[np.int64]] = []
    scene_numbers: list[NDArray[np.int64]] = []
    quantities: list[Float] = []
    tables = [(scene, labelled_rows(scene)) for scene in scenes]
    total = sum(len(table) for _, table in tables)
    with tqdm(total=total, desc="pool views", unit="view", disable=not progress) as bar:
        for number, (scene, table) in enumerate(tables):
            describer = LandmarkDescriber(scene.localization_map(device=device))
            cam_from_world = poses(table)
            good = is_good(table, *limits)
            location_ids = table["location_id"].to_numpy(np.int64)
            for camera, rows in views_by_camera(scene, table, BLOCK):
                block = cam_from_world[rows]
                described = describer.of_camera(camera).describe(block)
                values.append(pool(described, block, camera).cpu().numpy())
                quantities.append(view_quantities(described, described.counts, camera_quantities(camera)))
                labels.append(good[rows])
                location.append(location_ids[rows])
                scene_numbers.append(np.full(len(rows), number))
                bar.update(len(rows))
    of_scenes = np.concatenate(scene_numbers), np.concatenate(location)
    return PooledViews(np.concatenate(values), np.concatenate(labels), *of_scenes, np.concatenate(quantities))


def learn_trees(task: Task) -> Learnt:
    """Boosted trees from a dataset's train scenes; see `fit_trees`.

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
    return Learnt(trees, metrics, class_counts(train=train.labels, val=val.labels))


def fit_trees(
    train: PooledViews, val: PooledViews, camera: Camera | None, config: TreesConfig, seed: int = 0
) -> tuple[BoostedTrees, dict[str, float]]:
    """Boost trees, keep as many as order the validation views best, and calibrate their sum on these.

    Returns the trees and metrics. LightGBM samples views by the seed to choose bins.
    """
    import lightgbm
    from sklearn.metrics import average_precision_score, log_loss, roc_auc_score

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
    kept = max(precision, key=lambda number: precision[number])
    trees = BoostedTrees.of_lightgbm(booster, camera, kept)
    raw = trees.raw_logits(torch.from_numpy(val.values)).numpy()
    scale, offset = fit_platt(raw, val.labels)
    trees = replace(trees, scale=scale, offset=offset)
    logits = trees.logits(torch.from_numpy(val.values))
    bce = float(log_loss(val.labels, logits.sigmoid().numpy()))
    auc = float(roc_auc_score(val.labels, raw))
    kept_precision = precision[kept]
    metrics = {"n_trees": float(kept), "val_average_precision": kept_precision, "val_roc_auc": auc, "val_bce": bce}
    return trees, metrics
