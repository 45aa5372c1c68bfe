"""Fits what ships with looks: the confidence in a joint pose, and what a set of looks is worth.

    python -m wheretolook_paper.studies.fit_looks SCENE_FOLDER... [--places 60] [--sets 4]

Of validation scenes whose labels keep their pixels (`wheretolook label --label.store_pixels true`), looked at by one
camera. At each place sets of 1, 2, 3 and 5 looks are drawn at random, the likelier the higher their scores, and joined.
Two logistic regressions are fitted, and each is judged on scenes it was not fitted to, if there are several. Prints the
JSON of `labelling/confidence.json` and `looks/set_score.json`. The weight of the position's variance is not fitted but
given, as random sets do not tell what it is for: that looks which see the same fail together.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pandas as pd
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import log_loss, roc_auc_score

from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.viewpoint_table import is_good, poses, read_table
from wheretolook.geometry.poses import camera_centers
from wheretolook.localization import confidence
from wheretolook.localization.joint_labels import label_sets
from wheretolook.looks import set_score as worth
from wheretolook.looks.joint_visibility import candidate_views, log_position_variance
from wheretolook.utils.shipped import WEIGHTS, shipped
from wheretolook.weights.resolve import load_scorer

VARIANCE = 0.375  # how much the log of the position's variance counts, against the log-odds
SURE = 0.99


def drawn_sets(scene: SceneFolder, places: int, draws: int) -> pd.DataFrame:
    """Sets drawn at random, with what was expected of them and what became of them."""
    table = read_table(scene.table, pixels=True)
    around = scene.localization_map()
    scorer = load_scorer(str(shipped(WEIGHTS) / "set.safetensors"), around)
    rng = np.random.default_rng(0)
    cam_from_world = poses(table)
    scores = scorer.score(cam_from_world)
    sets = []
    told = []
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
            told.append((seen.p_none(looks), log_position_variance(seen.joint_sums(looks))))
    labelled = label_sets(table, sets, around.landmarks.points, scene.camera, progress=scene.name)
    expected = pd.DataFrame(told, columns=["failed", "log_position_variance"])
    return pd.concat([labelled, expected], axis=1).assign(scene=scene.name, good=is_good(labelled))


def report(name: str, inputs: np.ndarray, sets: pd.DataFrame) -> LogisticRegression:
    """Fit on all scenes; print how well a fit on the others does on each."""
    good = sets["good"].to_numpy()
    for scene in sets["scene"].unique() if sets["scene"].nunique() > 1 else []:
        own = (sets["scene"] == scene).to_numpy()
        chance = LogisticRegression().fit(inputs[~own], good[~own]).predict_proba(inputs[own])[:, 1]
        sure = chance >= SURE
        right = f"{good[own][sure].mean():.3f}" if sure.any() else "-"
        numbers = f"AUC {roc_auc_score(good[own], chance):.3f}, log loss {log_loss(good[own], chance):.3f}"
        print(f"{name}, without {scene}: {numbers}; {sure.sum()} of {own.sum()} sure at {SURE}, right of these {right}")
    return LogisticRegression().fit(inputs, good)


def main() -> None:
    """Fit and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--places", type=int, default=60)
    parser.add_argument("--sets", type=int, default=4)
    options = parser.parse_args()
    scenes = [SceneFolder(folder, "val") for folder in options.scenes]
    sets = pd.concat([drawn_sets(scene, options.places, options.sets) for scene in scenes], ignore_index=True)
    accepted = sets[sets["n_inliers"] >= 10]
    names = ("n_inliers", "n_matches", "elsewhere", "own", "rival_own", "deviation_deg")
    fitted = report("confidence", confidence.confidence_features(*(accepted[name] for name in names)), accepted)
    weights = dict(zip(confidence.FEATURE_NAMES, fitted.coef_[0].round(4).tolist(), strict=True))
    print(json.dumps({"weights": weights, "bias": round(float(fitted.intercept_[0]), 4)}, indent=2))
    chance = np.clip(1 - sets["failed"].to_numpy(), worth.MIN_PROBABILITY, 1 - worth.MIN_PROBABILITY)
    mixed = np.log(chance / (1 - chance)) - VARIANCE * sets["log_position_variance"].to_numpy()
    fitted = report("worth", mixed[:, None], sets)
    scale = float(fitted.coef_[0, 0])
    bias = float(fitted.intercept_[0])
    weights = dict(zip(worth.SetScoreModel.names, (round(scale, 4), round(-scale * VARIANCE, 4)), strict=True))
    print(json.dumps({"weights": weights, "bias": round(bias, 4)}, indent=2))


if __name__ == "__main__":
    main()
