"""Compares policies of extending a map by the target views that localize afterwards."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from wheretolook.evaluation.statistics import ClusterBootstrap
from wheretolook.tracking import NestedRun, Tags, TrackingConfig
from wheretolook_paper.evaluation.comparison import log_comparison

EXTEND_CSV = "extend.csv"
PHOTOGRAPHS_CSV = "extend_photographs.csv"


def outcomes(table: pd.DataFrame) -> pd.DataFrame:
    """Return which view (row) localizes with which policy (column); NaN where a policy was not measured.

    `table` is that of `wheretolook_paper.studies.extend`. A view is of a map: a scene and a seed.
    """
    columns = (table[name] for name in ("scene", "seed", "policy", "localized"))
    localized = {
        (scene, seed, policy): pd.Series([float(mark == "x") for mark in marks])
        for scene, seed, policy, marks in zip(*columns, strict=True)
    }
    names = ["scene", "seed", "policy", "view"]
    return pd.concat(localized, names=names).unstack("policy")


def difference(views: pd.DataFrame, policy: str, other: str) -> dict[str, float]:
    """Return how much larger the share of a policy is than that of another, on the views (`outcomes`) of both.

    Keys: gain, gain_low and gain_high, its 95 % interval over maps; won and lost, the views that only one localizes.
    """
    change = (views[policy] - views[other]).dropna()
    bootstrap = ClusterBootstrap(change.groupby(["scene", "seed"]).ngroup().to_numpy(), 2000, 0)
    low, high = bootstrap.ratio_interval(change.to_numpy(), np.ones(len(change)))
    counts = {"won": int((change > 0).sum()), "lost": int((change < 0).sum()), "views": len(change)}
    return {"gain": change.mean(), "gain_low": float(low), "gain_high": float(high), **counts}


def policies(table: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each policy: shares, and the `difference` from none."""
    views = outcomes(table)
    rows = []
    for policy, of_policy in table.groupby("policy", sort=False):
        shares = {name: np.average(of_policy[name], weights=of_policy["views"]) for name in ("strict", "coarse")}
        rows.append({"policy": policy, **shares, **difference(views, str(policy), "none")})
    return pd.DataFrame(rows)


def registrations(table: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each photograph of the plans: `p`, that it registers, and whether it does so, `registered`."""
    planned = table.dropna(subset=["p_registers", "registered"])
    p = [float(value) for text in planned["p_registers"] for value in str(text).split()]
    marks = [mark == "x" for text in planned["registered"] for mark in text]
    return pd.DataFrame({"p": p, "registered": marks})


def log_extend(tracking: TrackingConfig, dataset: str, results: Path, tags: Tags = None) -> str:
    """Log a run for each policy within one for all, which has the metrics of the planned pairs; return its id."""
    file = results / EXTEND_CSV
    names: Sequence[str] = ("strict", "coarse", "gain", "gain_low", "gain_high", "won", "lost", "views")
    metrics = {
        str(row["policy"]): {name: float(row[name]) for name in names if pd.notna(row[name])}
        for row in policies(pd.read_csv(file)).to_dict("records")
    }
    nested = [NestedRun(name, {"dataset": dataset, "policy": name}, of_policy) for name, of_policy in metrics.items()]
    return log_comparison(
        tracking, "all policies", "extend", {"dataset": dataset}, metrics["pairs"], nested, [file], tags
    )
