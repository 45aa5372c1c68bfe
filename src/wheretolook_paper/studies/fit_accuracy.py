"""Fit the bundled model of the accuracy of views to labelled datasets, and compare it with the network's own scores.

    wheretolook scenes --config kinds.yaml          (then map, sample, label)
    python -m wheretolook_paper.studies.fit_accuracy --datasets '[data/release, data/kinds]'

kinds.yaml has scenes and cameras unlike those of the release, of seeds that the bundled network has not seen:

    {name: kinds, scenes: {train: 8, test: 0, seed: 700, kinds: [court, building, hall, office], apartment: {vary: true}},
     mapping: {draw_camera: true}, sample: {grid: [14, 14, 8], keep: 0, cameras: 20, max_locations: 60, max_directions: 10}}

Apartments of the splits train and val are each judged by a fit on all other scenes, scenes of other kinds by a fit on
those of other kinds than theirs, and test scenes by the fit on all of these. Prints, for each accuracy, the share of
views within it, and AUC and calibration error of the model and of the network's own probability; then the model.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
from jsonargparse import auto_cli
from sklearn.linear_model import LinearRegression, LogisticRegression
from sklearn.metrics import roc_auc_score

from wheretolook import load_scorer
from wheretolook.dataset.config import ACCURACY, Accuracy, Split
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.viewpoint_table import CAMERA_ID, LOCALIZED, poses
from wheretolook.evaluation.statistics import expected_calibration_error
from wheretolook.geometry.poses import Float
from wheretolook.localization.confidence import RIGHT_PLACE_LIMITS
from wheretolook.scorers.base import finite_log_odds
from wheretolook.scorers.set.accuracy import MARGIN, STATISTICS, AccuracyModel, LogError, probabilities, statistics_of
from wheretolook.scorers.set.score import SetScorer
from wheretolook_paper.studies.fit_confidence import ACCURACIES, is_within

LEAST = (1e-5, 1e-4)  # error in metres and degrees: labels are rounded
SPLITS: tuple[Split, ...] = ("train", "val", "test")
APARTMENT = "apartment"  # the kind of the release
VIEWS = 6000  # of a scene, drawn at random


def read_views(scene: SceneFolder, weights: Path) -> pd.DataFrame:
    """Return errors (infinite without a pose), the network's probability `own` and `STATISTICS` of a scene's views."""
    table = scene.read_table()
    table = table.sample(min(VIEWS, len(table)), random_state=0).reset_index(drop=True)
    numbers = table[CAMERA_ID] if CAMERA_ID in table else pd.Series(0, index=table.index)
    parts = []
    for number, camera in scene.cameras().items():
        part = table[numbers == number]
        scorer = load_scorer(scene.localization_map(camera), weights)
        assert isinstance(scorer, SetScorer)
        views = poses(part)
        for rows, described, n_visible in scorer.describer.in_blocks(views, scorer.max_landmarks):
            sums = scorer.network.sums_of(described, n_visible)
            statistics = pd.DataFrame(statistics_of(scorer.trained, sums), columns=STATISTICS)
            found = part.iloc[rows][["error_m", "error_deg", "status"]].reset_index(drop=True)
            own = probabilities(scorer.trained, scorer.accuracy, sums)
            parts.append(pd.concat([found, statistics], axis=1).assign(own=own, scene=scene.name))
    table = pd.concat(parts, ignore_index=True)
    table.loc[table["status"] != LOCALIZED, ["error_m", "error_deg"]] = np.inf
    return table


def fit(views: pd.DataFrame) -> AccuracyModel:
    """Fit both factors, with the same weight for every scene: the place to all views, the errors at the right place."""
    weight = (1 / views.groupby("scene")["own"].transform("size")).to_numpy()
    weight = weight / weight.mean()
    place = is_within(views, RIGHT_PLACE_LIMITS)
    variance = views["log_orientation_variance"].to_numpy()
    features = np.stack([finite_log_odds(views["own"].to_numpy(), MARGIN), variance], axis=-1)
    logistic = LogisticRegression(C=1e3, max_iter=2000).fit(features, place, weight)
    right = views[place]
    features = right[list(AccuracyModel.inputs)].to_numpy()
    deviation = right["log_position_variance"].to_numpy() / 2
    errors = []
    for unit, least, known in zip(("m", "deg"), LEAST, (deviation, 0 * deviation), strict=True):
        target = np.log(np.maximum(right[f"error_{unit}"].to_numpy(np.float64), least)) - known
        line = LinearRegression().fit(features, target, weight[place])
        spread = float(np.sqrt(np.average((target - line.predict(features)) ** 2, weights=weight[place])))
        errors.append(LogError(tuple(line.coef_.round(4).tolist()), round(float(line.intercept_), 4), round(spread, 4)))
    bias = round(float(logistic.intercept_[0]), 4)
    return AccuracyModel(tuple(logistic.coef_[0].round(4).tolist()), bias, tuple(errors))


def predict(model: AccuracyModel, views: pd.DataFrame, accuracy: Accuracy) -> Float:
    """Predict the probabilities (B,) that views are within an accuracy."""
    return model.at(accuracy, ACCURACY, views["own"].to_numpy(), views[list(STATISTICS)].to_numpy())


def compare(title: str, parts: list[tuple[AccuracyModel, pd.DataFrame]]) -> None:
    """Print AUC and calibration error of views by models, and of the network's own probability, at each accuracy."""
    print(f"{title}: {sum(len(views) for _, views in parts)} views of {len(parts)} scenes")
    for accuracy in ACCURACIES:
        good = np.concatenate([is_within(views, accuracy) for _, views in parts])
        own = np.concatenate([views["own"] for _, views in parts])
        model = np.concatenate([predict(model, views, accuracy) for model, views in parts])
        numbers = ", ".join(
            f"{name} AUC {roc_auc_score(good, values):.4f}, error {expected_calibration_error(values, good):.3f}"
            for name, values in (("model", model), ("own", own))
        )
        print(f"  {accuracy[0]} m, {accuracy[1]} degrees: {good.mean():.3f} within; {numbers}")


def main(datasets: tuple[Path, ...], weights: Path = Path("data/release/weights")) -> None:
    """Fit the model, compare, and print the model.

    Args:
        datasets: labelled datasets; their test scenes are only judged.
        weights: of the set network.
    """
    scenes = [(split, scene) for root in datasets for split in SPLITS for scene in Dataset.load(root).split(split)]
    views = {scene.name: (split, read_views(scene, weights)) for split, scene in scenes}
    known = {name: part for name, (split, part) in views.items() if split != "test"}
    groups: dict[str, list[tuple[AccuracyModel, pd.DataFrame]]] = {}
    for name, part in known.items():
        kind = name.rsplit("-", 1)[0]
        alike = name if kind == APARTMENT else kind
        rest = fit(pd.concat([other for key, other in known.items() if not key.startswith(alike)]))
        groups.setdefault("apartments" if kind == APARTMENT else "other kinds", []).append((rest, part))
    model = fit(pd.concat([*known.values()]))
    if tested := [(model, part) for split, part in views.values() if split == "test"]:
        groups["test"] = tested
    for title, parts in groups.items():
        compare(title, parts)
    kinds = zip(("position", "orientation"), model.errors, strict=True)
    errors = {
        kind: {
            "weights": dict(zip(STATISTICS, error.weights, strict=True)),
            "bias": error.bias,
            "deviation": error.deviation,
        }
        for kind, error in kinds
    }
    place = dict(zip(AccuracyModel.names, model.weights, strict=True))
    print(json.dumps({"weights": place, "bias": model.bias, "errors": errors}, indent=2))


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
