"""Fit the bundled model of the confidence in a pose.

    wheretolook relocalize --config my.yaml --in-scenes '[val-0, val-1, ...]' --policies '[random]' --places 60
    python -m wheretolook_paper.studies.fit_confidence --poses data/my/results/relocalize/poses.parquet

Every pose hypothesis of the simulated views counts, also those that were not chosen. Each scene is judged by a fit on
the others, at several accuracies. Prints the JSON of the model.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
from jsonargparse import auto_cli
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import roc_auc_score

from wheretolook.dataset.config import Accuracy
from wheretolook.evaluation.statistics import expected_calibration_error
from wheretolook.geometry.poses import Float
from wheretolook.localization.confidence import (
    MIN_INLIERS,
    RIGHT_PLACE_LIMITS,
    ConfidenceModel,
    ErrorModel,
    confidence_features,
)

ACCURACIES: tuple[Accuracy, ...] = ((0.01, 0.1), (0.02, 0.2), (0.05, 0.4), (0.1, 1.0), (0.25, 2.0), (0.5, 5.0))
INPUTS = ("n_inliers", "n_matches", "elsewhere", "own", "rival_own", "deviation_deg")


def features_of(poses: pd.DataFrame) -> Float:
    """Return the features (B, K) of pose hypotheses."""
    return confidence_features(*(poses[name] for name in INPUTS))


def is_within(poses: pd.DataFrame, accuracy: Accuracy) -> np.ndarray:
    """Return which poses (B,) are within an accuracy."""
    errors = poses[["error_m", "error_deg"]].to_numpy(np.float64)
    return np.asarray((errors <= accuracy).all(axis=1))


def fit(poses: pd.DataFrame) -> ConfidenceModel:
    """Fit both factors to pose hypotheses."""
    place = is_within(poses, RIGHT_PLACE_LIMITS)
    fitted = LogisticRegression(C=1e3, max_iter=1000).fit(features_of(poses), place)
    right = poses[place & np.isfinite(poses["deviation_m"].to_numpy())]
    errors = []
    for unit in ("m", "deg"):
        predicted = np.log(right[f"deviation_{unit}"].to_numpy())
        actual = np.log(right[f"error_{unit}"].to_numpy())
        slope, offset = np.polyfit(predicted, actual, 1)
        deviation = float((actual - slope * predicted - offset).std())
        errors.append(ErrorModel(round(float(slope), 4), round(float(offset), 4), round(deviation, 4)))
    weights = tuple(fitted.coef_[0].round(4).tolist())
    return ConfidenceModel(weights, round(float(fitted.intercept_[0]), 4), tuple(errors))


def fit_missing(model: ConfidenceModel, poses: pd.DataFrame, weight: Float) -> tuple[float, float, float]:
    """Fit `ConfidenceModel.by_missing` to poses with a column "missing" and a weight each (B,)."""
    log_odds = np.clip(model.log_odds(features_of(poses)), -7, 7)
    missing = np.log(np.maximum(poses["missing"].to_numpy(), 0.02))
    inputs = np.column_stack([log_odds, missing])
    fitted = LogisticRegression(C=10, max_iter=3000).fit(inputs, is_within(poses, RIGHT_PLACE_LIMITS), weight)
    slope, of_missing = fitted.coef_[0].round(3).tolist()
    return slope, of_missing, round(float(fitted.intercept_[0]), 3)


def scene_weights(poses: pd.DataFrame) -> Float:
    """Return weights (B,), one in the mean, with which every kind of scene (its name up to "-") and in it every scene counts alike.

    Buildings, most of whose rooms have an unmapped copy here, count half; poses that were not chosen a quarter.
    """
    scene = poses["scene"]
    kind = scene.str.split("-").str[0]
    n_scenes = kind.map(scene.groupby(kind).nunique())
    rivals = np.where(poses["hypothesis"] == 0, 1.0, 0.25)
    half = np.where(kind == "building", 0.5, 1.0)
    weight = np.asarray(half * rivals / scene.map(scene.value_counts()) / n_scenes, dtype=np.float64)
    return np.asarray(weight / weight.mean())


def predict(model: ConfidenceModel, poses: pd.DataFrame, accuracy: Accuracy) -> Float:
    """Predict the probabilities (B,) that poses are within an accuracy."""
    place = model.predict_proba(features_of(poses))
    limits = zip(model.errors, accuracy, ("deviation_m", "deviation_deg"), strict=True)
    below = [[error.p_below(limit, value) for value in poses[name]] for error, limit, name in limits]
    return place * np.min(below, axis=0)


def main(poses: tuple[Path, ...], place: bool = True) -> None:
    """Fit the model, judge each scene by a fit on the others, and print the model.

    Args:
        poses: `results/relocalize/poses.parquet` of datasets of validation scenes.
        place: fit everything; otherwise only what corrects the bundled model by what is missing, for which the poses
            are of scenes that repeat, too.
    """
    table = pd.concat([pd.read_parquet(path) for path in poses], ignore_index=True)
    table = table[table["n_inliers"] >= MIN_INLIERS].reset_index(drop=True)
    scenes = table["scene"].unique()
    models = {scene: fit(table[table["scene"] != scene]) for scene in scenes} if len(scenes) > 1 else {}
    chosen = table[table["hypothesis"] == 0]
    for accuracy in ACCURACIES if models else ():
        found = [predict(models[scene], chosen[chosen["scene"] == scene], accuracy) for scene in scenes]
        good = np.concatenate([is_within(chosen[chosen["scene"] == scene], accuracy) for scene in scenes])
        probability = np.concatenate(found)
        sure = probability >= 0.99
        numbers = (
            f"AUC {roc_auc_score(good, probability):.3f}, error {expected_calibration_error(probability, good):.3f}"
        )
        right = f"{good[sure].mean():.3f} of {sure.sum()} at 0.99" if sure.any() else "none at 0.99"
        print(f"{accuracy[0]} m, {accuracy[1]} degrees: {good.mean():.3f} right; {numbers}; right {right}")
    model = fit(table) if place else ConfidenceModel.bundled()
    errors = {name: vars(error) for name, error in zip(("position", "orientation"), model.errors, strict=True)}
    weights = dict(zip(model.names, model.weights, strict=True))
    by_missing = ConfidenceModel.bundled().by_missing
    if "missing" in table and np.isfinite(table["missing"]).all():
        by_missing = fit_missing(model, table, scene_weights(table))
    missing = dict(zip(("slope", "weight", "bias"), by_missing, strict=True))
    print(json.dumps({"weights": weights, "bias": model.bias, "errors": errors, "missing": missing}, indent=2))


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
