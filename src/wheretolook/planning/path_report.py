"""What planned paths were worth: the share of their views that localize, with intervals, and what that costs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.planning.config import PathsConfig
from wheretolook.planning.path_comparison import FORWARD
from wheretolook.utils.markdown import markdown_table
from wheretolook.utils.tracking import NestedRun, TrackingConfig, log_nested, start_run
from wheretolook.viewpoints.table import LOCALIZED

PATHS_CSV, PATHS_MD, PATHS_PNG = "paths.csv", "paths.md", "paths.png"
"""Files of a comparison, in `<dataset>/results/` and as artifacts of its run."""

ALL = "all"
"""Name of the rows over all scenes."""


def summarize_paths(paths: pd.DataFrame, views: pd.DataFrame, config: PathsConfig) -> pd.DataFrame:
    """A row for each scene, and for all, task and method.

    Args:
        paths: `wheretolook.planning.path_comparison.ComparedPaths.paths` of all scenes, with a column `scene`.
        views: their views, with `scene`, `status`, `error_m` and `error_deg`.
        config: limits of the errors, resamples, seed.

    Returns:
        `localized`, the share of all views that localize; over the pairs that both planned, `times_forward`, that share
        over the one of "forward", and `times_forward_length`; the former two with the ends of 95 % intervals by
        resampling pairs within scenes; `failures` to plan, `turn_deg_per_m`, `promised`. What there is nothing to tell
        of is NaN.
    """
    good = (
        (views["status"] == LOCALIZED)
        & (views["error_m"] < config.max_error_m)
        & (views["error_deg"] < config.max_error_deg)
    )
    key = ["scene", "task", "method", "pair"]
    counted = views.assign(good=good).groupby(key, sort=False)["good"].agg(["sum", "size"]).reset_index()
    table = paths.merge(counted.rename(columns={"sum": "good", "size": "n"}), on=key, how="left")
    table[["good", "n"]] = table[["good", "n"]].fillna(0)
    scenes = list(dict.fromkeys(paths["scene"]))
    rows = []
    for scene in [*scenes, *([ALL] if len(scenes) > 1 else [])]:
        here = table if scene == ALL else table[table["scene"] == scene]
        draws = _draws(here, config)
        for task, of_task in here.groupby("task", sort=False):
            forward = of_task[of_task["method"] == FORWARD]
            for method, of_method in of_task.groupby("method", sort=False):
                rows.append({"scene": scene, "task": task, "method": method, **_row(of_method, forward, draws)})
    return pd.DataFrame(rows)


def _draws(table: pd.DataFrame, config: PathsConfig) -> NDArray[np.int64]:
    """How often each pair of `_pairs_of` is drawn, (resamples, P): pairs within their scenes, with replacement."""
    pairs = _pairs_of(table)
    rng = np.random.default_rng(config.seed)
    times = np.zeros((config.resamples, len(pairs)), dtype=np.int64)
    scene = pairs.get_level_values("scene")
    for name in dict.fromkeys(scene):
        columns = np.flatnonzero(scene == name)
        drawn = rng.integers(0, len(columns), (config.resamples, len(columns)))
        for row, picks in enumerate(drawn):
            np.add.at(times[row], columns[picks], 1)
    return times


def _pairs_of(table: pd.DataFrame) -> pd.MultiIndex:
    return pd.MultiIndex.from_frame(table[["scene", "pair"]].drop_duplicates())


def _row(of_method: pd.DataFrame, forward: pd.DataFrame, draws: NDArray[np.int64]) -> dict[str, Any]:
    index = _pairs_of(forward)
    one, base = (table.set_index(["scene", "pair"]).reindex(index) for table in (of_method, forward))
    both = (one["planned"] & base["planned"]).fillna(False).to_numpy(bool)
    counts = {name: table[["good", "n"]].fillna(0).to_numpy() for name, table in (("one", one), ("base", base))}

    def share(name: str, weights: NDArray[Any]) -> NDArray[Any]:
        good, n = (weights @ counts[name]).T
        return np.divide(good, n, out=np.full(len(weights), np.nan), where=n > 0)

    def ratio(weights: NDArray[Any]) -> NDArray[Any]:
        ours, theirs = (share(name, weights * both) for name in ("one", "base"))
        return np.divide(ours, theirs, out=np.full(len(weights), np.nan), where=theirs > 0)

    whole = np.ones((1, len(index)))
    shares, ratios = _interval(share("one", draws)), _interval(ratio(draws))
    metres = float(of_method["length_m"].sum())
    lengths = one["length_m"].to_numpy()[both].sum(), base["length_m"].to_numpy()[both].sum()
    return {
        "pairs": len(of_method),
        "failures": int((~of_method["planned"]).sum()),
        "views": int(counts["one"][:, 1].sum()),
        "localized": float(share("one", whole)[0]),
        "localized_low": shares[0],
        "localized_high": shares[1],
        "times_forward": float(ratio(whole)[0]),
        "times_forward_low": ratios[0],
        "times_forward_high": ratios[1],
        "times_forward_length": float(lengths[0] / lengths[1]) if lengths[1] else float("nan"),
        "length_m": float(of_method["length_m"].mean()),
        "turn_deg_per_m": float(of_method["turn_deg"].sum() / metres) if metres else float("nan"),
        "promised": float(of_method["promised"].mean()),
    }


def _interval(draws: NDArray[Any]) -> tuple[float, float]:
    """Ends of the 95 % interval of what is known."""
    known = draws[np.isfinite(draws)]
    low, high = np.percentile(known, (2.5, 97.5)) if len(known) else (np.nan, np.nan)
    return float(low), float(high)


def path_markdown(summary: pd.DataFrame, config: PathsConfig) -> str:
    """The summary as Markdown, a table for each task."""
    text = [f"Share of the views along paths that localize within {config.max_error_m:g} m and "
            f"{config.max_error_deg:g}°, in % [95 % interval over pairs]."]  # fmt: skip
    titles = {"planned": "Places and views planned", "given": "Views along a given path"}
    for task, rows in summary.groupby("task", sort=False):
        header = ["scene", "method", "localized", "times forward", "length / forward's", "turn, °/m", "not found"]
        lines = [
            [
                str(row["scene"]), str(row["method"]),
                f"{100 * row['localized']:.1f} [{100 * row['localized_low']:.1f}, {100 * row['localized_high']:.1f}]",
                f"{row['times_forward']:.2f} [{row['times_forward_low']:.2f}, {row['times_forward_high']:.2f}]",
                f"{row['times_forward_length']:.2f}", f"{row['turn_deg_per_m']:.0f}", f"{row['failures']}",
            ]
            for _, row in rows.iterrows()
        ]  # fmt: skip
        text += [f"{titles[str(task)]}:", markdown_table(header, lines)]
    return "\n\n".join(text) + "\n"


def log_paths(
    params: Mapping[str, Any],
    summary: pd.DataFrame,
    results: Path,
    tracking: TrackingConfig,
    tags: Mapping[str, str] | None = None,
) -> str:
    """Log a comparison: a run with its files, and in it one for each task and method over all scenes.

    Args:
        params: of the comparison, such as the dataset.
        summary: of `summarize_paths`.
        results: folder of the files; those that are missing are left out.
        tracking: where to log.
        tags: further tags.

    Returns:
        Id of the run.
    """
    pooled = summary[summary["scene"] == summary["scene"].iloc[-1]]
    with start_run(tracking, f"paths {params['dataset']}", "paths", params, tags=tags) as (client, run):
        for name in (PATHS_CSV, PATHS_MD, PATHS_PNG):
            if (results / name).is_file():
                client.log_artifact(run, str(results / name))
        nested = []
        for row in pooled.to_dict("records"):
            about = {**params, "task": row["task"], "method": row["method"]}
            numbers = {str(key): float(value) for key, value in row.items() if key not in ("scene", "task", "method")}
            nested.append(NestedRun(f"paths {row['task']} {row['method']}", about, numbers))
        log_nested(tracking, run, "paths", nested, tags)
    return run
