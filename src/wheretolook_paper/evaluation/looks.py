"""Tables of view sets: the share of locations localized by each selection strategy, and the number of views needed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd

from wheretolook.evaluation.statistics import ClusterBootstrap
from wheretolook.tracking import BEST_TAG, TrackingConfig
from wheretolook.utils.files import write_text
from wheretolook.utils.texts import markdown_table

LOOKS_CSV = "looks.csv"
LOOKS_MD = "looks.md"

NUMBERS = (1, 2, 3, 5)
"""Compared numbers of views in a set."""

STRATEGIES = {
    "together": "chosen together, by what they see together",
    "in-turn": "one added after another, by what is seen with those before; none is exchanged",
    "one-by-one": "the best alone, at least 40° apart",
    "even": "spread evenly, from the best alone on",
    "visible": "the most different landmarks in view",
    "fisher": "exact Fisher information of the rig (log det)",
    "random": "drawn at random",
}

TOGETHER = "together"
"""The product's strategy."""

_NUMBERS = ("good", "gain", "any_good", "sure", "sure_right")


def look_table(sets: pd.DataFrame, resamples: int = 2000, seed: int = 0) -> pd.DataFrame:
    """Return the share of locations whose sets localize jointly, by strategy and number of views.

    Columns: `good` and its 95 % interval by resampling locations; `gain` over the best single view of the same
    locations, paired, and its interval; `any_good`; `sure`, the share of poses with a confidence of at least 99 %, and
    `sure_right`, the share of these that is right.
    """
    rows = []
    for (strategy, n), part in sets.groupby(["strategy", "n_looks"], sort=False):
        good = part["good"].to_numpy(float)
        values = np.stack([good, good - part["single_good"].to_numpy(float)], axis=1)
        bootstrap = ClusterBootstrap(np.arange(len(part)), resamples, seed)
        low, high = bootstrap.ratio_interval(values, np.ones((len(part), 1)))
        mean = values.mean(0)
        sure = part["confidence"] >= 0.99
        rows.append(
            {"strategy": strategy, "n_looks": n, "n_locations": len(part)}
            | {"good": mean[0], "good_low": low[0], "good_high": high[0]}
            | {"gain": mean[1], "gain_low": low[1], "gain_high": high[1]}
            | {"any_good": part["any_good"].mean(), "sure": sure.mean()}
            | {"sure_right": part.loc[sure, "good"].mean() if sure.any() else np.nan}
        )
    return pd.DataFrame(rows)


def stopping_table(sets: pd.DataFrame, asked: Sequence[float] = (0.5, 0.8, 0.9, 0.95, 0.99)) -> pd.DataFrame:
    """Return how many views are needed if the camera stops once the confidence reaches a limit.

    Uses sets whose views are added one after another ("in-turn"). Columns: `asked`, the limit; `looks`, the mean
    number; `good`, the share of locations; `of_most`, relative to the share of the largest sets.
    """
    in_turn = sets[sets["strategy"] == "in-turn"].sort_values("n_looks", kind="stable")
    locations = [part for _, part in in_turn.groupby(["scene", "location_id"])]
    most = np.mean([part["good"].iloc[-1] for part in locations]) if locations else np.nan
    rows: list[dict[str, float]] = []
    for limit in asked:
        stops = [
            part.iloc[int(np.argmax(np.append(part["confidence"].to_numpy()[:-1] >= limit, True)))]
            for part in locations
        ]
        good = float(np.mean([stop["good"] for stop in stops]))
        looks = float(np.mean([stop["n_looks"] for stop in stops]))
        rows.append({"asked": limit, "looks": looks, "good": good, "of_most": float(good / most)})
    return pd.DataFrame(rows)


def write_looks(folder: Path, sets: pd.DataFrame, title: str) -> pd.DataFrame:
    """Write `looks.csv` and `looks.md` of compared sets; return `look_table`."""
    table = look_table(sets)
    stopping = stopping_table(sets)
    write_text(folder / LOOKS_CSV, table.to_csv(index=False))
    shares = [
        [row.strategy, str(row.n_looks), str(row.n_locations), _share(row.good, row.good_low, row.good_high),
         _share(row.gain, row.gain_low, row.gain_high), f"{100 * row.any_good:.1f}", f"{100 * row.sure:.1f}",
         "" if np.isnan(row.sure_right) else f"{100 * row.sure_right:.1f}"]
        for row in cast("Iterable[Any]", table.itertuples())
    ]  # fmt: skip
    head = ["looks", "N", "places", "localized together", "over one look", "any alone", "sure", "of these right"]
    stops = [
        [f"{r.asked:.2f}", f"{r.looks:.2f}", f"{100 * r.good:.1f}", f"{100 * r.of_most:.1f}"]
        for r in cast("Iterable[Any]", stopping.itertuples())
    ]
    parts = [f"# {title}", markdown_table(head, shares)]
    parts += ["## When to stop", markdown_table(["asked", "looks", "localized", "of all looks' share"], stops)]
    write_text(folder / LOOKS_MD, "\n\n".join(parts) + "\n")
    return table


def _share(value: float, low: float, high: float) -> str:
    return f"{100 * value:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def log_looks(
    tracking: TrackingConfig,
    table: pd.DataFrame,
    params: Mapping[str, Any],
    files: Sequence[Path],
    tags: Mapping[str, str] | None = None,
) -> str:
    """Log a `look_table` as a run with files and a nested run for each row; return the run's id.

    The run has the metrics of the best strategy for the largest sets.
    """
    from wheretolook.tracking import NestedRun, log, log_nested, start_run

    numbers = [name for name in _NUMBERS if name in table]
    best = table[table["n_looks"] == table["n_looks"].max()].nlargest(1, "good").iloc[0]
    run_tags = {**(tags or {}), "dataset": str(params["dataset"]), BEST_TAG: str(best["strategy"])}
    with start_run(tracking, "all sets", "looks", dict(params), tags=run_tags) as (client, run):
        log(client, run, metrics={name: float(best[name]) for name in numbers})
        for file in files:
            client.log_artifact(run, str(file))
        runs = (
            NestedRun(
                f"{row['strategy']}, {row['n_looks']} looks",
                {**params, "strategy": row["strategy"], "n_looks": row["n_looks"]},
                {name: float(row[name]) for name in numbers},
            )
            for row in table.to_dict("records")
        )
        log_nested(tracking, run, "looks", runs, dict(tags or {}))
    return run
