"""Fit the bundled score of a set of views.

    python -m wheretolook_paper.studies.fit_looks --scenes '[FOLDER, ...]' [--places 60] [--draws 4]

The scenes are validation scenes with one camera whose labels store pixels (`--label.store_pixels true`). At each
location, sets of 1, 2, 3 and 5 views are drawn with probabilities that grow with their scores, and localized jointly.
A logistic regression is fitted, and tested on scenes that it was not fitted to. Prints its JSON. The weight of the
position's variance is fixed, because random sets do not show that views of the same landmarks fail together.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
from jsonargparse import auto_cli
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import log_loss, roc_auc_score

from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.viewpoint_files import read_table
from wheretolook.dataset.viewpoint_table import is_good, poses
from wheretolook.geometry.poses import camera_centers
from wheretolook.looks import selection as set_score
from wheretolook.looks.selection import candidate_views, log_position_variance
from wheretolook.scorers.weights import load_scorer
from wheretolook.utils.package import WEIGHTS, shipped
from wheretolook_paper.evaluation.looks import label_sets

VARIANCE = 0.375  # weight of the log of the position's variance, relative to the log-odds
SURE = 0.99


def drawn_sets(scene: SceneFolder, places: int, draws: int) -> pd.DataFrame:
    """Draw sets of views at random locations; return their expected and actual results."""
    table = read_table(scene.table, pixels=True)
    localization_map = scene.localization_map()
    scorer = load_scorer(localization_map, str(shipped(WEIGHTS) / "set.safetensors"))
    rng = np.random.default_rng(0)
    cam_from_world = poses(table)
    scores = scorer.score(cam_from_world)
    sets = []
    expectations = []
    of_place = list(table.groupby("location_id").indices.values())
    for number in rng.permutation(len(of_place))[:places]:
        rows = of_place[number]
        center = camera_centers(cam_from_world[rows[:1]])[0]
        axes = cam_from_world[rows, 2, :3]
        seen = candidate_views(scorer, center, axes, scores[rows])
        likely = scores[rows] + 0.02
        for n in np.tile((1, 2, 3, 5), draws):
            looks = rng.choice(len(rows), n, replace=False, p=likely / likely.sum())
            sets.append(rows[looks])
            expectations.append((seen.p_none(looks), log_position_variance(seen.joint_sums(looks))))
    labelled = label_sets(table, sets, localization_map.landmarks.points, scene.camera, progress=scene.name)
    expected = pd.DataFrame(expectations, columns=["failed", "log_position_variance"])
    return pd.concat([labelled, expected], axis=1).assign(scene=scene.name, good=is_good(labelled))


def report(name: str, inputs: np.ndarray, sets: pd.DataFrame) -> LogisticRegression:
    """Fit on all scenes; print how well a fit on the others does on each scene."""
    good = sets["good"].to_numpy()
    for scene in sets["scene"].unique() if sets["scene"].nunique() > 1 else []:
        own = (sets["scene"] == scene).to_numpy()
        probability = LogisticRegression().fit(inputs[~own], good[~own]).predict_proba(inputs[own])[:, 1]
        sure = probability >= SURE
        right = f"{good[own][sure].mean():.3f}" if sure.any() else "-"
        numbers = f"AUC {roc_auc_score(good[own], probability):.3f}, log loss {log_loss(good[own], probability):.3f}"
        print(f"{name}, without {scene}: {numbers}; {sure.sum()} of {own.sum()} sure at {SURE}, right of these {right}")
    return LogisticRegression().fit(inputs, good)


def main(scenes: tuple[Path, ...], places: int = 60, draws: int = 4) -> None:
    """Draw sets, fit the model and print it.

    Args:
        scenes: scene folders.
        places: locations in each scene.
        draws: sets of each number of views at a location.
    """
    sets = pd.concat([drawn_sets(SceneFolder(folder, "val"), places, draws) for folder in scenes], ignore_index=True)
    probability = np.clip(1 - sets["failed"].to_numpy(), 1e-3, 1 - 1e-3)  # as in `SetScoreModel`
    mixed = np.log(probability / (1 - probability)) - VARIANCE * sets["log_position_variance"].to_numpy()
    fitted = report("set score", mixed[:, None], sets)
    scale = float(fitted.coef_[0, 0])
    bias = float(fitted.intercept_[0])
    weights = dict(zip(set_score.SetScoreModel.names, (round(scale, 4), round(-scale * VARIANCE, 4)), strict=True))
    print(json.dumps({"weights": weights, "bias": round(bias, 4)}, indent=2))


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
