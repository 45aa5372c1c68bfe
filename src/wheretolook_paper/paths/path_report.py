"""Results of a comparison of planned paths: the share of their views that localize, their lengths and turns."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.dataset.thresholds import ALL
from wheretolook.dataset.viewpoint_table import LOCALIZED
from wheretolook.planning.config import FORWARD, PathsConfig
from wheretolook.tracking.config import TrackingConfig
from wheretolook.tracking.runs import (
    ALL_METHODS,
    BEST_TAG,
    FINGERPRINT_TAG,
    NestedRun,
    Tags,
    fingerprint_of,
    joined,
    log,
    log_nested,
    logged_last,
    start_run,
)
from wheretolook.utils.markdown import markdown_table

PATHS_CSV = "paths.csv"
PATHS_MD = "paths.md"
PATHS_PNG = "paths.png"
"""Files of a comparison, in `<dataset>/results/` and as artifacts of its run."""


def summarize_paths(paths: pd.DataFrame, views: pd.DataFrame, config: PathsConfig) -> pd.DataFrame:
    """A row for each scene (and all of them), task and method, NaN where there is no data.

    `paths` and `views` are those of `wheretolook_paper.paths.path_comparison.ComparedPaths` of all scenes, with a column
    `scene`, the views also with `status`, `error_m` and `error_deg`.

    Returns:
        `localized`, the share of all views that localize; `times_forward` and `times_forward_length`, the ratios of
        this share and of the length to those of "forward", over the pairs that both could plan; 95 % intervals of the
        first two by resampling pairs within scenes; `failures` to plan, `turn_deg_per_m`, and `promised`, the mean
        score. Where `paths` tell `n_looks`, also `looks`, how many are taken at a place on average.
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
        draws = _draws(here, config)
        for task, of_task in here.groupby("task", sort=False):
            forward = of_task[of_task["method"] == FORWARD]
            for method, of_method in of_task.groupby("method", sort=False):
                rows.append({"scene": scene, "task": task, "method": method, **_row(of_method, forward, draws)})
    return pd.DataFrame(rows)


def _draws(table: pd.DataFrame, config: PathsConfig) -> NDArray[np.int64]:
    """How often each pair of `_pairs_of` is drawn, (resamples, P), with replacement within its scene."""
    scene = _pairs_of(table).get_level_values("scene")
    rng = np.random.default_rng(config.seed)
    times = np.zeros((config.resamples, len(scene)), dtype=np.int64)
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
    method, base = (table.set_index(["scene", "pair"]).reindex(index) for table in (of_method, forward))
    both = (method["planned"] & base["planned"]).fillna(False).to_numpy(bool)
    counts, base_counts = (table[["good", "n"]].fillna(0).to_numpy() for table in (method, base))

    def quotient(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
        return np.divide(a, b, out=np.full(len(a), np.nan), where=b > 0)

    def ratio(weights: NDArray[Any]) -> NDArray[Any]:
        return quotient(*(quotient(*((weights * both) @ table).T) for table in (counts, base_counts)))

    whole = np.ones((1, len(index)))
    metres = float(of_method["length_m"].sum())
    lengths = [table["length_m"].to_numpy()[both].sum() for table in (method, base)]
    return {
        "pairs": len(of_method),
        "failures": int((~of_method["planned"]).sum()),
        "views": int(counts[:, 1].sum()),
        "localized": float(quotient(*(whole @ counts).T)[0]),
        **_interval("localized", quotient(*(draws @ counts).T)),
        "times_forward": float(ratio(whole)[0]),
        **_interval("times_forward", ratio(draws)),
        "times_forward_length": float(lengths[0] / lengths[1]) if lengths[1] else float("nan"),
        "length_m": float(of_method["length_m"].mean()),
        "turn_deg_per_m": float(of_method["turn_deg"].sum() / metres) if metres else float("nan"),
        "promised": float(of_method["promised"].mean()),
        **_looks(of_method),
    }


def _looks(of_method: pd.DataFrame) -> dict[str, float]:
    if "n_looks" not in of_method:
        return {}
    places = float(of_method["n_views"].sum())
    return {"looks": float(of_method["n_looks"].sum()) / places if places else float("nan")}


def _interval(name: str, draws: NDArray[Any]) -> dict[str, float]:
    """Ends of the 95 % interval of the draws that are finite, by the names of their columns."""
    known = draws[np.isfinite(draws)]
    low, high = np.percentile(known, (2.5, 97.5)) if len(known) else (np.nan, np.nan)
    return {f"{name}_low": float(low), f"{name}_high": float(high)}


def path_markdown(summary: pd.DataFrame, config: PathsConfig) -> str:
    """The summary as Markdown, a table for each task."""
    limits = f"{config.max_error_m:g} m and {config.max_error_deg:g}°"
    text = [f"Share of the views along paths that localize within {limits}, in % [95 % interval over pairs]."]
    titles = {"planned": "Places and views planned", "given": "Views along a given path"}
    for task, rows in summary.groupby("task", sort=False):
        header = ["scene", "method", "localized", "times forward", "length / forward's", "turn, °/m", "not found"]
        told = "looks" in rows
        header += ["looks a place"] if told else []
        lines = []
        for _, row in rows.iterrows():
            localized, low, high = (f"{100 * row[f'localized{end}']:.1f}" for end in ("", "_low", "_high"))
            times, least, most = (f"{row[f'times_forward{end}']:.2f}" for end in ("", "_low", "_high"))
            cells = [f"{localized} [{low}, {high}]", f"{times} [{least}, {most}]", f"{row['times_forward_length']:.2f}"]
            cells += [f"{row['turn_deg_per_m']:.0f}", f"{row['failures']}"]
            cells += [f"{row['looks']:.2f}"] if told else []
            lines.append([str(row["scene"]), str(row["method"]), *cells])
        text += [f"{titles[str(task)]}:", markdown_table(header, lines)]
    return "\n\n".join(text) + "\n"


def log_paths(
    params: Mapping[str, Any], summary: pd.DataFrame, results: Path, tracking: TrackingConfig, tags: Tags = None
) -> str:
    """Log a comparison: a run with its files, and in it one for each task and method over all scenes.

    `params` describe the comparison, `summary` is of `summarize_paths`, `results` the folder of the files, of which
    missing ones are left out. Returns the id of the run, which has the numbers of the method of whose planned paths the
    largest share localizes. If the newest comparison of the dataset was of the same and found the same, nothing is
    logged, and the id is that of its run.
    """
    mark = fingerprint_of(params, summary.to_csv(index=False))
    if (known := logged_last(tracking, "paths", params["dataset"], mark, PATHS_CSV)) is not None:
        return known
    pooled = summary[summary["scene"] == summary["scene"].iloc[-1]]
    best = pooled[pooled["task"] == pooled["task"].iloc[0]].sort_values("localized", ascending=False).iloc[0]
    all_tags = {**(tags or {}), FINGERPRINT_TAG: mark, BEST_TAG: str(best["method"])}
    first = {name: float(best[name]) for name in ("localized", "times_forward", "times_forward_length")}
    with start_run(tracking, ALL_METHODS, "paths", params, tags=all_tags) as (client, run):
        log(client, run, metrics=first)
        for name in (PATHS_CSV, PATHS_MD, PATHS_PNG):
            if (results / name).is_file():
                client.log_artifact(run, str(results / name))
        nested = []
        for row in pooled.to_dict("records"):
            about = {**params, "task": row["task"], "method": row["method"]}
            numbers = {str(key): float(value) for key, value in row.items() if key not in ("scene", "task", "method")}
            nested.append(NestedRun(joined(row["method"], row["task"]), about, numbers))
        log_nested(tracking, run, "paths", nested, tags)
    return run
