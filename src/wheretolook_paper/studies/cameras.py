"""Choose the scorer for any camera: regret, AUC and calibration over different scenes and fields of view.

    python -m wheretolook_paper.studies.cameras --datasets '[data/cameras]' --weights data/release/weights --out a.csv
    python -m wheretolook_paper.studies.cameras --datasets '[data/test-45, data/test-60]' --split test --weights ...

Datasets are labelled. The first line chooses on the val scenes of `configs/cameras.yaml`, the second tests by angle on
datasets of the same scenes and maps made with `--camera.fov_deg 45 --mapping.camera '{fov_deg: 90}'` and so on. Scenes of
a kind (`building-537` is a building) are averaged first, then kinds; narrow cameras (below 60 degrees) and wide ones
(above 95) count as two more kinds where scenes have several cameras. 95 % intervals are over locations, neighbours
resampled together; differences to the first method are paired.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jsonargparse import auto_cli
from sklearn.metrics import roc_auc_score

from wheretolook.dataset.config import Split
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_table import CAMERA_ID, is_good, poses
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.scoring import score_scenes
from wheretolook.evaluation.statistics import ClusterBootstrap, expected_calibration_error
from wheretolook.geometry.camera import field_of_view_deg
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.scorers.registry import is_probability
from wheretolook.training.weights import method_of_weights
from wheretolook_paper.evaluation.comparison import replace_rows

LIMITS = 0.05, 0.4  # metres and degrees
SHARES = ("expected-inliers", "visible")  # scores that are shares of a map's landmarks
SQUARE_M = 1.0  # locations in one square of the floor are resampled together
DRAWS = 2000


def scored(root: Path, split: Split, methods: tuple[str, ...], weights: list[Path]) -> pd.DataFrame:
    """Return all labelled views of a split, with a column of scores for each method."""
    dataset = Dataset.load(root)
    scenes = dataset.split(split)
    tables = [scene.read_table() for scene in scenes]
    served = {path: method_of_weights(path) for path in weights}
    config = EvaluateConfig(methods=methods, reference="")
    scores, _ = score_scenes(scenes, tables, config, served, "cpu", True, None)
    parts = []
    for scene, table in zip(scenes, tables, strict=True):
        cameras = scene.cameras()
        numbers = table[CAMERA_ID] if CAMERA_ID in table else pd.Series(0, index=table.index)
        across = {number: field_of_view_deg(camera)[0] for number, camera in cameras.items()}
        squares = np.floor(camera_centers(poses(table))[:, :2] / SQUARE_M).astype(int)
        about = {
            "dataset": root.name,
            "scene": scene.name,
            "kind": scene.name.rsplit("-", 1)[0] if scene.name[-1].isdigit() else "others'",
            "location": scene.name + " " + table["location_id"].astype(str),
            "square": [f"{scene.name} {x} {y}" for x, y in squares],
            "across": numbers.map(across) if len(across) > 1 else next(iter(across.values())),
            "good": is_good(table, *LIMITS),
            "right": is_good(table, 0.5, 5.0),  # within which a pose is not a wrong hypothesis
            "inliers": table["n_inliers"],
            "n_landmarks": len(scene.read_landmarks()),
        }
        parts.append(pd.DataFrame(about))
    views = pd.concat(parts, ignore_index=True).assign(**scores)
    return views.assign(**{name: views[name] * views["n_landmarks"] for name in SHARES if name in views})


def groups(views: pd.DataFrame) -> list[tuple[str, str, pd.DataFrame]]:
    """Return kind, name and views of each scene, and of narrow and wide cameras where scenes have several cameras."""
    found = [(str(part["kind"].iloc[0]), str(name), part) for name, part in views.groupby("scene", sort=False)]
    if views.groupby("scene")["across"].nunique().max() > 1:
        found.append(("narrow", "narrow cameras", views[views["across"] < 60]))
        found.append(("wide", "wide cameras", views[views["across"] > 95]))
    return found


def regrets(views: pd.DataFrame, method: str) -> pd.Series:
    """Return the regret (0 or 1) of the best view by a method, by location."""
    order = views.sort_values(method, ascending=False, kind="stable").groupby("location")["good"]
    return order.any().astype(float) - order.first().astype(float)


def summary(views: pd.DataFrame, methods: list[str]) -> pd.DataFrame:
    """Return a row for each group and method, for each kind, and for the mean over kinds."""
    locations = views.drop_duplicates("location").set_index("location")
    strata, clusters = (pd.factorize(locations[name])[0] for name in ("scene", "square"))
    bootstrap = ClusterBootstrap(clusters, DRAWS, 0, strata)
    rows: list[dict[str, Any]] = []
    draws: list[Float] = []  # regret of each row: of the data, then of the resamples
    for kind, name, part in groups(views):
        for method in methods:
            regret = regrets(part, method)
            known = regret.reindex(locations.index)
            draws.append(100 * bootstrap.ratios(known.fillna(0).to_numpy(), known.notna().astype(float).to_numpy()))
            row = {"kind": kind, "group": name, "method": method, "n_locations": len(regret), "n_views": len(part)}
            row |= {"good": part["good"].mean(), "regret": draws[-1][0]}
            row["auc"] = roc_auc_score(part["good"], part[method])
            if is_probability(method):
                row["ece"] = expected_calibration_error(part[method].to_numpy(), part["good"].to_numpy())
            if method == "expected-inliers":
                right = part[part["right"]]
                row["real_over_expected"] = right["inliers"].sum() / right[method].sum()
            rows.append(row)
    table = pd.DataFrame(rows).assign(draws=pd.Series(list(draws)))
    numbers = {name: "mean" for name in ("regret", "auc", "ece", "draws") if name in table}
    of_kinds = table.groupby(["kind", "method"], sort=False).agg(numbers | {"draws": _mean}).reset_index()
    means = of_kinds.groupby("method", sort=False).agg(numbers | {"draws": _mean}).reset_index()
    of_kinds = of_kinds.assign(group="all " + of_kinds["kind"])
    table = pd.concat([table, of_kinds, means.assign(kind="mean", group="mean")], ignore_index=True)
    first = table[table["method"] == methods[0]].set_index("group")["draws"]
    for index, row_draws, group in zip(table.index, table["draws"], table["group"], strict=True):
        table.loc[index, ["regret_low", "regret_high"]] = np.quantile(row_draws[1:], (0.025, 0.975))
        table.loc[index, ["more_low", "more_high"]] = np.quantile((row_draws - first[group])[1:], (0.025, 0.975))
    return table.drop(columns="draws")


def _mean(draws: pd.Series) -> Float:
    return np.mean(np.stack(draws.to_list()), 0)


def main(
    datasets: tuple[Path, ...],
    split: Split = "val",
    weights: Path = Path("data/release/weights"),
    methods: tuple[str, ...] = ("set", "expected-inliers", "bins", "visible"),
    out: Path | None = None,
) -> None:
    """Score the datasets, print and write the table.

    Args:
        datasets: labelled datasets.
        split: the scenes that are scored.
        weights: folder of weights.
        methods: what is compared; differences are to the first.
        out: CSV file of the table; rows of other datasets in it are kept.
    """
    paths = [path for path in sorted(weights.glob("*.safetensors")) if not path.stem.startswith("mlp")]
    for root in datasets:
        table = summary(scored(root, split, methods, paths), list(methods))
        table.insert(0, "dataset", root.name)
        table.insert(1, "split", split)
        print(f"\n{root.name}, {split}")
        shown = table[(table["group"] == "mean") | table["group"].str.startswith("all ")]
        print(shown.drop(columns=["dataset", "split"]).to_string(index=False, float_format=lambda x: f"{x:.3f}"))
        if out is not None:
            replace_rows(out, table.round(4), ["dataset"])


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
