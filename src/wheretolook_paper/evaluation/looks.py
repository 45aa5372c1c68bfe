"""Sets of looks in tables: how many places they localize, by how they were chosen; how many looks are needed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd

from wheretolook.tracking.config import TrackingConfig
from wheretolook.tracking.runs import BEST_TAG
from wheretolook.utils.files import write_text
from wheretolook.utils.markdown import markdown_table

LOOKS_CSV = "looks.csv"
LOOKS_MD = "looks.md"

NUMBERS = (1, 2, 3, 5)
"""Looks of a set that are compared."""

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
"""What ships."""

_NUMBERS = ("good", "gain", "any_good", "sure", "sure_right")


def look_table(sets: pd.DataFrame, resamples: int = 2000, seed: int = 0) -> pd.DataFrame:
    """Shares of locations whose looks localize together, by strategy and number of looks.

    Columns: `good` and its 95 % interval by resampling locations; `gain` over the single best look of the same places,
    paired, and its interval; `any_good`; `sure` (the share of poses called sure at 99 %) and `sure_right` (how many of
    these are right).
    """
    rng = np.random.default_rng(seed)
    rows = []
    for (strategy, n), part in sets.groupby(["strategy", "n_looks"], sort=False):
        good = part["good"].to_numpy(float)
        gain = (part["good"].astype(float) - part["single_good"]).to_numpy()
        drawn = rng.integers(0, len(part), (resamples, len(part)))
        low, high = np.quantile(good[drawn].mean(1), (0.025, 0.975))
        gain_low, gain_high = np.quantile(gain[drawn].mean(1), (0.025, 0.975))
        sure = part["confidence"] >= 0.99
        rows.append(
            {"strategy": strategy, "n_looks": n, "n_locations": len(part), "good": good.mean()}
            | {"good_low": low, "good_high": high, "gain": gain.mean(), "gain_low": gain_low, "gain_high": gain_high}
            | {"any_good": part["any_good"].mean(), "sure": sure.mean()}
            | {"sure_right": part.loc[sure, "good"].mean() if sure.any() else np.nan}
        )
    return pd.DataFrame(rows)


def stopping_table(sets: pd.DataFrame, asked: Sequence[float] = (0.5, 0.8, 0.9, 0.95, 0.99)) -> pd.DataFrame:
    """How many looks are needed if the camera looks on only while the confidence is below what is asked.

    Of sets whose looks are added one after another ("in-turn", of every number that was compared). Columns: `asked`,
    `looks` (mean), `good` (share of locations), `of_most` (of what the greatest number gives).
    """
    wanted = sets[sets["strategy"] == "in-turn"].sort_values("n_looks", kind="stable")
    ends: list[dict[str, float]] = []
    places = [part for _, part in wanted.groupby(["scene", "location_id"])]
    most = np.mean([part["good"].iloc[-1] for part in places]) if places else np.nan
    for limit in asked:
        stops = [int(np.argmax(np.append(part["confidence"].to_numpy()[:-1] >= limit, True))) for part in places]
        looks = [part["n_looks"].iloc[stop] for part, stop in zip(places, stops, strict=True)]
        good = np.mean([part["good"].iloc[stop] for part, stop in zip(places, stops, strict=True)])
        ends.append(
            {"asked": limit, "looks": float(np.mean(looks)), "good": float(good), "of_most": float(good / most)}
        )
    return pd.DataFrame(ends)


def write_looks(folder: Path, sets: pd.DataFrame, title: str) -> pd.DataFrame:
    """Write `looks.csv` and `looks.md` of compared sets; returns `look_table`."""
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
    """Log a table of `look_table` as a run with the files, and one nested in it for each row; returns its id.

    The run has the metrics of the best choice of most looks.
    """
    from wheretolook.tracking.runs import NestedRun, log, log_nested, start_run

    numbers = [name for name in _NUMBERS if name in table]
    best = table[table["n_looks"] == table["n_looks"].max()].nlargest(1, "good").iloc[0]
    told = {**(tags or {}), "dataset": str(params["dataset"]), BEST_TAG: str(best["strategy"])}
    with start_run(tracking, "all sets", "looks", dict(params), tags=told) as (client, run):
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
