"""Summary of compared paths: the share of views that localize, lengths and rotations; as a table and MLflow runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from wheretolook.dataset.config import ALL
from wheretolook.dataset.viewpoint_table import LOCALIZED
from wheretolook.evaluation.statistics import ClusterBootstrap, divide
from wheretolook.planning.config import FORWARD
from wheretolook.tracking import (
    ALL_METHODS,
    BEST_TAG,
    FINGERPRINT_TAG,
    NestedRun,
    Tags,
    TrackingConfig,
    fingerprint_of,
    joined,
    logged_last,
)
from wheretolook.utils.texts import markdown_table
from wheretolook_paper.evaluation.comparison import interval_text, log_comparison
from wheretolook_paper.paths.config import PathsConfig

PATHS_CSV = "paths.csv"
PATHS_MD = "paths.md"
PATHS_PNG = "paths.png"
"""Files of a comparison, in `<dataset>/results/` and as artifacts of its run."""


def summarize_paths(paths: pd.DataFrame, views: pd.DataFrame, config: PathsConfig) -> pd.DataFrame:
    """Summarize paths and labelled views of all scenes: a row for each scene (and all of them), task and method.

    Args:
        paths: those of `ComparedPaths` of all scenes, with a column `scene`.
        views: likewise, with `status`, `error_m` and `error_deg`.
        config: limits of the errors, and the resamples.

    Returns:
        `localized`, the share of all views that localize; `times_forward` and `times_forward_length`, the ratios of
        this share and of the length to those of "forward", over the pairs planned by both; 95 % intervals of the
        first two by resampling pairs within scenes; `failures` to plan, `turn_deg_per_m`, and `promised`, the mean
        score. If `paths` have `n_looks`, also `looks`, the mean number of views at a waypoint. NaN without data.
    """
    near = (views["error_m"] < config.max_error_m) & (views["error_deg"] < config.max_error_deg)
    good = near & (views["status"] == LOCALIZED)
    key = ["scene", "task", "method", "pair"]
    counted = views.assign(good=good).groupby(key, sort=False)["good"].agg(["sum", "size"]).reset_index()
    table = paths.merge(counted.rename(columns={"sum": "good", "size": "n"}), on=key, how="left")
    table[["good", "n"]] = table[["good", "n"]].fillna(0)
    scenes = list(dict.fromkeys(paths["scene"]))
    rows = []
    for scene in [*scenes, *([ALL] if len(scenes) > 1 else [])]:
        here = table if scene == ALL else table[table["scene"] == scene]
        for task, of_task in here.groupby("task", sort=False):
            forward = of_task[of_task["method"] == FORWARD].set_index(["scene", "pair"])
            strata = forward.index.get_level_values("scene").map(scenes.index).to_numpy(np.int64)
            pairs = forward.index.get_level_values("pair").to_numpy(np.int64)
            bootstrap = ClusterBootstrap(pairs, config.resamples, config.seed, strata)
            for method, of_method in of_task.groupby("method", sort=False):
                row = _row(of_method, forward, bootstrap)
                rows.append({"scene": scene, "task": task, "method": method, **row})
    return pd.DataFrame(rows)


def _row(of_method: pd.DataFrame, forward: pd.DataFrame, bootstrap: ClusterBootstrap) -> dict[str, Any]:
    """Return the numbers of a method, given the rows of "forward" by scene and pair, and a bootstrap of these."""
    method = of_method.set_index(["scene", "pair"]).reindex(forward.index)
    both = (method["planned"] & forward["planned"]).fillna(False).to_numpy(bool)
    good, n = method[["good", "n"]].fillna(0).to_numpy().T
    base_good, base_n = forward[["good", "n"]].to_numpy().T
    localized = bootstrap.ratios(good, n)
    times = divide(bootstrap.ratios(good * both, n * both), bootstrap.ratios(base_good * both, base_n * both))
    low, high = bootstrap.interval(np.stack([localized, times], axis=1))
    metres = float(of_method["length_m"].sum())
    lengths = [float(table["length_m"].to_numpy()[both].sum()) for table in (method, forward)]
    row = {
        "pairs": len(of_method),
        "failures": int((~of_method["planned"]).sum()),
        "views": int(n.sum()),
        "localized": float(localized[0]),
        "localized_low": float(low[0]),
        "localized_high": float(high[0]),
        "times_forward": float(times[0]),
        "times_forward_low": float(low[1]),
        "times_forward_high": float(high[1]),
        "times_forward_length": lengths[0] / lengths[1] if lengths[1] else float("nan"),
        "length_m": float(of_method["length_m"].mean()),
        "turn_deg_per_m": float(of_method["turn_deg"].sum() / metres) if metres else float("nan"),
        "promised": float(of_method["promised"].mean()),
    }
    if "n_looks" in of_method:
        waypoints = float(of_method["n_views"].sum())
        row["looks"] = float(of_method["n_looks"].sum()) / waypoints if waypoints else float("nan")
    return row


def pooled_paths(of_scenes: pd.DataFrame) -> pd.DataFrame:
    """Combine the rows of scenes in tables of `summarize_paths`: a row for each task and method, scene "all".

    Shares are weighted by views, the ends of their intervals combined as of independent scenes; `times_forward` is the
    ratio of the shares and has no interval. Lengths are weighted by planned paths, rotations by metres.
    """
    rows = []
    for (task, method), part in of_scenes.groupby(["task", "method"], sort=False):
        of_views = part["views"] / part["views"].sum()
        planned = part["pairs"] - part["failures"]
        of_paths = planned / planned.sum()
        metres = planned * part["length_m"]
        localized = (of_views * part["localized"]).sum()
        below, above = (
            np.sqrt(((of_views * (part[end] - part["localized"])) ** 2).sum())
            for end in ("localized_low", "localized_high")
        )
        row = {"scene": ALL, "task": task, "method": method, **part[["pairs", "failures", "views"]].sum()}
        row |= {"localized": localized, "localized_low": localized - below, "localized_high": localized + above}
        row |= {name: (of_paths * part[name]).sum() for name in ("times_forward_length", "length_m")}
        row |= {"turn_deg_per_m": (part["turn_deg_per_m"] * metres).sum() / metres.sum()}
        row |= {"promised": (of_views * part["promised"]).sum(skipna=False)}
        rows.append(row)
    table = pd.DataFrame(rows)
    forward = table[table["method"] == FORWARD].set_index("task")["localized"]
    table["times_forward"] = table["localized"] / table["task"].map(forward)
    return table


def path_markdown(summary: pd.DataFrame, config: PathsConfig) -> str:
    """Format the summary of `summarize_paths` as Markdown, a table for each task."""
    limits = f"{config.max_error_m:g} m and {config.max_error_deg:g}°"
    text = [f"Share of the views along paths that localize within {limits}, in % [95 % interval over pairs]."]
    titles = {"planned": "Places and views planned", "given": "Views along a given path"}
    for task, rows in summary.groupby("task", sort=False):
        header = ["scene", "method", "localized", "times forward", "length / forward's", "turn, °/m", "not found"]
        with_looks = "looks" in rows
        header += ["looks a place"] if with_looks else []
        lines = []
        for _, row in rows.iterrows():
            cells = [interval_text(row, "localized"), interval_text(row, "times_forward", 1, 2)]
            cells += [f"{row['times_forward_length']:.2f}"]
            cells += [f"{row['turn_deg_per_m']:.0f}", f"{row['failures']}"]
            cells += [f"{row['looks']:.2f}"] if with_looks else []
            lines.append([str(row["scene"]), str(row["method"]), *cells])
        text += [f"{titles[str(task)]}:", markdown_table(header, lines)]
    return "\n\n".join(text) + "\n"


def log_paths(
    params: Mapping[str, Any], summary: pd.DataFrame, results: Path, tracking: TrackingConfig, tags: Tags = None
) -> str:
    """Log a comparison as a run with its files and a nested run for each task and method; return the run's id.

    `params` describe the comparison, `summary` is that of `summarize_paths`; files missing in the folder `results` are
    skipped. The run has the numbers of the method with the largest share of localized views on its own paths. If the
    newest comparison of the dataset has the same parameters and results, its id is returned and nothing is logged.
    """
    mark = fingerprint_of(params, summary.to_csv(index=False))
    if (known := logged_last(tracking, "paths", params["dataset"], mark, PATHS_CSV)) is not None:
        return known
    pooled = summary[summary["scene"] == summary["scene"].iloc[-1]]
    best = pooled[pooled["task"] == pooled["task"].iloc[0]].sort_values("localized", ascending=False).iloc[0]
    nested = []
    for row in pooled.to_dict("records"):
        about = {**params, "task": row["task"], "method": row["method"]}
        numbers = {str(key): float(value) for key, value in row.items() if key not in ("scene", "task", "method")}
        nested.append(NestedRun(joined(row["method"], row["task"]), about, numbers))
    metrics = {name: float(best[name]) for name in ("localized", "times_forward", "times_forward_length")}
    files = [path for name in (PATHS_CSV, PATHS_MD, PATHS_PNG) if (path := results / name).is_file()]
    best_of = {FINGERPRINT_TAG: mark, BEST_TAG: str(best["method"])}
    return log_comparison(tracking, ALL_METHODS, "paths", params, metrics, nested, files, tags, best_of)
