"""Fit the bundled model of the accuracy of views to labelled datasets, and compare it with the scorer's own probability.

    python -m wheretolook_paper.studies.fit_accuracy --datasets '[data/release]'
    python -m wheretolook_paper.studies.fit_accuracy --datasets '[data/release]' --others '[data/cameras]'

Scenes of the splits train and val are each judged by a fit on the others, and test scenes by the fit on all of these;
none of them trained the bundled network. `--others` are judged by that fit, too. Prints, for each accuracy, the share
of views within it, and AUC and calibration error of the model and of the network's own probability; then the JSON of
the model.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd
from jsonargparse import auto_cli
from sklearn.linear_model import LinearRegression, LogisticRegression
from sklearn.metrics import roc_auc_score

from wheretolook import load_scorer
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.viewpoint_table import CAMERA_ID, LOCALIZED, poses
from wheretolook.evaluation.calibration import expected_calibration_error
from wheretolook.geometry.poses import Float
from wheretolook.localization.confidence import ACCURACY, RIGHT_PLACE_LIMITS, Accuracy
from wheretolook.scorers.set.accuracy import VARIANCE, AccuracyModel, LogError, probabilities, statistics_of
from wheretolook.scorers.set.network import ALL_STATISTICS
from wheretolook.scorers.set.score import SetScorer
from wheretolook_paper.studies.fit_confidence import ACCURACIES, is_within

LEAST = (1e-5, 1e-4)  # error in metres and degrees: labels are rounded
VIEWS = 6000  # of a scene, drawn at random


def read_views(dataset: Dataset, scene: SceneFolder, weights: Path) -> pd.DataFrame:
    """Return errors (infinite without a pose), the network's probability `own` and `ALL_STATISTICS` of a scene's views."""
    table = scene.read_table()
    table = table.sample(min(VIEWS, len(table)), random_state=0).reset_index(drop=True)
    numbers = table[CAMERA_ID] if CAMERA_ID in table else pd.Series(0, index=table.index)
    parts = []
    for number, camera in scene.cameras().items():
        part = table[numbers == number]
        scorer = load_scorer(weights, scene.localization_map(dataset.camera).of_camera(camera))
        assert isinstance(scorer, SetScorer)
        views = poses(part)
        for rows, described, n_visible in scorer.describer.in_blocks(views, scorer.max_landmarks):
            sums = scorer._sums(views[rows], described, n_visible)
            statistics = pd.DataFrame(statistics_of(scorer.network, *sums), columns=ALL_STATISTICS)
            found = part.iloc[rows][["error_m", "error_deg", "status"]].reset_index(drop=True)
            own = probabilities(scorer.trained, scorer.accuracy, *sums)
            parts.append(pd.concat([found, statistics], axis=1).assign(own=own, scene=scene.name))
    table = pd.concat(parts, ignore_index=True)
    table.loc[table["status"] != LOCALIZED, ["error_m", "error_deg"]] = np.inf
    return table


def fit(views: pd.DataFrame) -> AccuracyModel:
    """Fit both factors: the place to all views, the errors to those at the right place."""
    place = is_within(views, RIGHT_PLACE_LIMITS)
    features = views[list(AccuracyModel.names)].to_numpy()
    logistic = LogisticRegression(C=1e3, max_iter=2000).fit(features, place)
    right = views[place]
    deviation = right[ALL_STATISTICS[VARIANCE]].to_numpy() / 2
    errors = []
    for unit, least, known in zip(("m", "deg"), LEAST, (deviation, 0 * deviation), strict=True):
        target = np.log(np.maximum(right[f"error_{unit}"].to_numpy(np.float64), least)) - known
        line = LinearRegression().fit(features[place], target)
        spread = float((target - line.predict(features[place])).std())
        errors.append(LogError(tuple(line.coef_.round(4).tolist()), round(float(line.intercept_), 4), round(spread, 4)))
    bias = round(float(logistic.intercept_[0]), 4)
    return AccuracyModel(tuple(logistic.coef_[0].round(4).tolist()), bias, tuple(errors))


def predict(model: AccuracyModel, views: pd.DataFrame, accuracy: Accuracy) -> Float:
    """Predict the probabilities (B,) that views are within an accuracy."""
    return model.at(accuracy, ACCURACY, views["own"].to_numpy(), views[list(ALL_STATISTICS)].to_numpy())


def compare(title: str, parts: Iterable[tuple[AccuracyModel, pd.DataFrame]]) -> None:
    """Print AUC and calibration error of views by models, and of the network's own probability, at each accuracy."""
    parts = list(parts)
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


def main(
    datasets: tuple[Path, ...], others: tuple[Path, ...] = (), weights: Path = Path("data/release/weights")
) -> None:
    """Fit the model, compare, and print the model.

    Args:
        datasets: labelled datasets to fit to.
        others: labelled datasets to judge only.
        weights: of the set network.
    """
    views: dict[str, list[pd.DataFrame]] = {"train": [], "val": [], "test": [], "others": []}
    for root in (*datasets, *others):
        dataset = Dataset.load(root)
        for split in ("train", "val", "test"):
            part = views["others" if root in others else split]
            part.extend(read_views(dataset, scene, weights) for scene in dataset.split(split))
    known = views["train"] + views["val"]
    held_out = [(fit(pd.concat(known[:row] + known[row + 1 :])), scene) for row, scene in enumerate(known)]
    compare("each scene by a fit on the others", held_out)
    model = fit(pd.concat(known))
    for title in ("test", "others"):
        if views[title]:
            compare(title, [(model, scene) for scene in views[title]])
    kinds = zip(("position", "orientation"), model.errors, strict=True)
    names = AccuracyModel.names
    errors = {
        kind: {
            "weights": dict(zip(names, error.weights, strict=True)),
            "bias": error.bias,
            "deviation": error.deviation,
        }
        for kind, error in kinds
    }
    place = dict(zip(names, model.weights, strict=True))
    print(json.dumps({"weights": place, "bias": model.bias, "errors": errors}, indent=2))


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
