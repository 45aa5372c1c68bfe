"""Would a network that learns from sets of looks choose better ones than the two numbers of a set's worth?

    python tests/benchmarks/study_looks.py SCENE_FOLDER... [--places 30]

Of validation scenes whose labels keep their pixels (`wheretolook label --label.store_pixels true`), looked at by one
camera. At each place sets of two, three and five looks are drawn at random, the likelier the higher their scores, and
joined; so are those that `wheretolook evaluate` compares. Networks and logistic regressions are given more and more of
what is known of a set before looking, and learn on all scenes but one; on that one each chooses among all sets of a
place. Printed are AUC, log loss, the share of places where the chosen set localizes, what the rules without learning
reach, and the share of places where any of the sets does: no choice among them reaches more.
"""

from __future__ import annotations

import argparse
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import log_loss, roc_auc_score
from sklearn.neural_network import MLPClassifier
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.viewpoint_table import is_good, poses, read_table
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.localization.joint_labels import label_sets
from wheretolook.looks.joint_visibility import PRIOR, SeenAround, information_matrices, seen_around
from wheretolook.looks.selection import Turns, best_one_by_one, choose_looks, evenly_spread
from wheretolook.looks.set_score import SetWorth, count_worth
from wheretolook.utils.shipped import WEIGHTS, shipped
from wheretolook.weights.resolve import load_scorer

DRAWN = {2: 14, 3: 10, 5: 3}
"""Sets drawn at a place, by their number of looks."""

TOLD = {
    "as ships": ("log_odds_alone", "log_position_variance"),
    "and orientation, overlap, angles": (
        "log_odds_alone", "log_odds_best", "log_position_variance", "log_orientation_variance", "overlap", "log_looks",
        "least_angle",
    ),
    "and counts, second look, mean": (
        "log_odds_alone", "log_odds_best", "log_odds_second", "log_odds_mean", "log_position_variance",
        "log_orientation_variance", "log_expected", "log_expected_sum", "log_visible", "overlap", "log_looks",
        "least_angle", "mean_angle",
    ),
}  # fmt: skip


def log_odds(chance: Any) -> Any:
    """Of chances, kept from 0 and 1."""
    kept = np.clip(chance, 1e-3, 1 - 1e-3)
    return np.log(kept / (1 - kept))


def told_of(looks: list[int], seen: SeenAround, sure: SeenAround, scores: Float, axes: Float) -> dict[str, float]:
    """What is known of a set before looking: all of `TOLD`."""
    sums = seen.union(looks)
    best = np.sort(log_odds(scores[looks]))[::-1]
    variances = np.linalg.inv(information_matrices(sums[1:]) + PRIOR * np.eye(6)).diagonal()
    expected = np.log1p(sums[0])
    alone = np.log1p(seen.sums()[looks, 0].sum())
    angles = [float(np.degrees(np.arccos(np.clip(axes[i] @ axes[j], -1, 1)))) for i, j in combinations(looks, 2)]
    return {
        "log_odds_alone": log_odds(1 - seen.failed(looks)),
        "log_odds_best": best[0],
        "log_odds_second": best[1],
        "log_odds_mean": best.mean(),
        "log_position_variance": np.log(variances[:3].sum()),
        "log_orientation_variance": np.log(variances[3:].sum()),
        "log_expected": expected,
        "log_expected_sum": alone,
        "log_visible": np.log1p(sure.union(looks)[0]),
        "overlap": expected - alone,
        "log_looks": np.log(len(looks)),
        "least_angle": min(angles),
        "mean_angle": float(np.mean(angles)),
    }


def sets_at(
    seen: SeenAround, sure: SeenAround, scores: Float, axes: Float, rng: np.random.Generator
) -> dict[tuple[int, ...], list[str]]:
    """Sets of looks at a place, and the rules that choose each; those drawn have none."""
    found = dict[tuple[int, ...], list[str]]()
    turns = Turns(axes)
    likely = np.exp(log_odds(scores) / 2)
    for n, drawn in DRAWN.items():
        if n > len(axes):
            continue
        ruled = {f"one by one, {apart}° apart": best_one_by_one(scores, axes, n, apart) for apart in (20, 40, 60)}
        ruled["together"] = list(choose_looks(seen, SetWorth.shipped(), n, turns, first=scores).looks)
        ruled["evenly spread"] = evenly_spread(axes, n, int(np.argmax(scores)))
        ruled["most visible"] = list(choose_looks(sure, count_worth, n, turns).looks)
        for rule, looks in ruled.items():
            found.setdefault(tuple(sorted(looks)), []).append(rule)
        for _ in range(drawn):
            looks = rng.choice(len(axes), n, replace=False, p=likely / likely.sum()).tolist()
            found.setdefault(tuple(sorted(looks)), [])
    return found


def sets_of(scene: SceneFolder, places: int) -> pd.DataFrame:
    """Sets at places of a scene: what is known of them, the rules that choose them, and whether they localize."""
    table = read_table(scene.table, pixels=True)
    around = scene.localization_map()
    rng = np.random.default_rng(0)
    scorer = load_scorer(str(shipped(WEIGHTS) / "set.safetensors"), around)
    cam_from_world = poses(table)
    scores = scorer.score(cam_from_world)
    sets = list[NDArray[np.int64]]()
    told = list[dict[str, Any]]()
    of_place = list(table.groupby("location_id").indices.values())
    for number in rng.permutation(len(of_place))[:places]:
        rows = of_place[number]
        center = camera_centers(cam_from_world[rows[:1]])[0]
        axes = cam_from_world[rows, 2, :3]
        seen, sure = (seen_around(scorer, center, axes, scores[rows], sure) for sure in (False, True))
        for looks, rules in sets_at(seen, sure, scores[rows], axes, rng).items():
            sets.append(rows[list(looks)])
            told.append({"rules": rules, **told_of(list(looks), seen, sure, scores[rows], axes)})
    labelled = label_sets(table, sets, around.landmarks.points, scene.camera, progress=scene.name)
    joined = pd.concat([pd.DataFrame(told), labelled[["n_looks", "location_id"]]], axis=1)
    return joined.assign(scene=scene.name, good=is_good(labelled))


def shares(sets: pd.DataFrame, chance: Float) -> str:
    """Places where the set of the highest chance localizes, in percent, by the number of looks."""
    told = []
    for n, part in sets.assign(chance=chance).groupby("n_looks"):
        chosen = part.loc[part.groupby(["scene", "location_id"])["chance"].idxmax()]
        told.append(f"{n} looks {100 * chosen['good'].mean():.1f}")
    return ", ".join(told)


def main() -> None:
    """Label sets, learn, choose and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--places", type=int, default=30)
    options = parser.parse_args()
    found = [sets_of(SceneFolder(folder, "val"), options.places) for folder in options.scenes]
    sets = pd.concat(found, ignore_index=True)
    good = sets["good"].to_numpy(bool)
    place = ["n_looks", "scene", "location_id"]
    print(f"{len(sets)} sets, {len(sets.groupby(place[1:]))} places")
    any_good = sets.groupby(place)["good"].any().groupby("n_looks").mean()
    print("any of the sets:", ", ".join(f"{n} looks {100 * share:.1f}" for n, share in any_good.items()))
    for rule in dict.fromkeys(rule for rules in sets["rules"] for rule in rules):
        print(f"{rule}: {shares(sets, np.array([float(rule in rules) for rules in sets['rules']]))}")
    for what, names in TOLD.items():
        inputs = sets[list(names)].to_numpy(float)
        network = MLPClassifier((32, 32), alpha=0.1, max_iter=15, random_state=0)
        for name, model in (("regression", LogisticRegression()), ("network", network)):
            chance = np.zeros(len(sets))
            for scene in sets["scene"].unique():
                own = (sets["scene"] == scene).to_numpy()
                fitted = make_pipeline(StandardScaler(), model).fit(inputs[~own], good[~own])
                chance[own] = fitted.predict_proba(inputs[own])[:, 1]
            numbers = f"AUC {roc_auc_score(good, chance):.3f}, log loss {log_loss(good, chance):.3f}"
            print(f"{name}, {what}: {numbers}; {shares(sets, chance)}")


if __name__ == "__main__":
    main()
