"""How much of a place localizes from a map alone: shares of target views, weak regions with their causes, mounts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from wheretolook.evaluation.statistics import ClusterBootstrap
from wheretolook.extend.config import TargetOptions
from wheretolook.extend.places import pitches_within
from wheretolook.geometry.views import Views
from wheretolook.space.free_space import FreeSpace

CAUSES = {"n_too_far": "too far", "n_too_oblique": "too oblique", "n_repeated": "repeated"}


@dataclass(frozen=True, eq=False)
class Audit:
    """Target views of a place, in the map's own frame, scored on the map.

    Attributes:
        views: the target views; `waypoint` is the row of the place.
        apart_m: how far neighbouring places are apart.
        space: free space; places with a wall between them are no neighbours. None if it is unknown.
    """

    views: Views
    apart_m: float
    space: FreeSpace | None = None

    @property
    def share(self) -> float:
        """Share of the target views that localize."""
        return float(self.views.score.mean())

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the share, over places; NaN for one place."""
        bootstrap = ClusterBootstrap(self.views.waypoint, 1000, 0)
        low, high = bootstrap.ratio_interval(self.views.score, np.ones(len(self.views)))
        return float(low), float(high)

    def places(self) -> pd.DataFrame:
        """Return a row for each place: the share there, mean numbers of landmarks, and the weak region with its cause.

        Neighbouring places where less than half of the views localize are a region; 1 is that with most views lost.
        """
        views = self.views
        means = {"share": views.score} | {name: getattr(views, name) for name in ("n_visible", *CAUSES)}
        table = pd.DataFrame(means).groupby(views.waypoint).mean()
        rows, first, n_views = np.unique(views.waypoint, return_index=True, return_counts=True)
        positions = views.positions[first]
        table[["x", "y", "z"]] = positions
        table.insert(0, "place", [views.waypoint_id[row] for row in first])
        table["n_views"] = n_views
        table["region"] = 0
        table["cause"] = ""
        weak = np.flatnonzero(table["share"] < 0.5)
        if len(weak):
            strong = table.loc[table["share"] >= 0.5, "n_visible"]
            usual = strong.median() if len(strong) else table["n_visible"].max()
            # neighbours in the plane; without a floor, the heights of places of a storey differ as those of the cameras
            reach_m = (1.6 * self.apart_m, 1.6 * self.apart_m, 1.5)
            centers = views.frame.world_from_map.apply(positions[weak])
            a, b = cKDTree(centers / reach_m).query_pairs(1.0, output_type="ndarray").T
            if self.space is not None:
                free = self.space.segments_are_free(centers[a], centers[b])
                a, b = a[free], b[free]
            joined = csr_array((np.ones(len(a)), (a, b)), shape=(len(weak), len(weak)))
            region = connected_components(joined, directed=False)[1]
            lost = np.bincount(region, (1 - table["share"].to_numpy()[weak]) * n_views[weak])
            for number, label in enumerate(np.argsort(-lost, kind="stable").tolist(), 1):
                members = rows[weak[region == label]]
                table.loc[members, ["region", "cause"]] = number, _cause(table.loc[members], usual)
        return table

    def regions(self) -> list[dict[str, Any]]:
        """Return the weak regions as records, that with most views lost first."""
        records = []
        for number, part in self.places().query("region > 0").groupby("region"):
            center = part[["x", "y", "z"]].mean().round(3).tolist()
            share = float(np.average(part["share"], weights=part["n_views"]))
            cause = part["cause"].iloc[0]
            records.append({"region": number, "cause": cause, "center": center, "places": len(part), "share": share})
        return records

    def record(self) -> dict[str, Any]:
        """Return all numbers as JSON values."""
        return {
            "share": self.share,
            "share_interval": [None if value != value else value for value in self.interval],
            "views": len(self.views),
            "method": self.views.method,
            "scale": self.views.frame.scale.source,
            "regions": self.regions(),
        }


def _cause(places: pd.DataFrame, usual: float) -> str:
    """Return why a region is weak: few landmarks are visible, or many of them are hard to match."""
    visible = places["n_visible"].sum()
    if visible <= 0.2 * usual * len(places):
        return "nothing mapped"
    shares = {cause: places[name].sum() / visible for name, cause in CAUSES.items()}
    worst = max(shares, key=shares.__getitem__)
    return worst if shares[worst] > 0.3 else "few landmarks"


def compare_mounts(audit: Callable[..., Audit], options: TargetOptions) -> pd.DataFrame:
    """Audit each height and pitch of the options, by a function that takes them, for a fixed camera: a row of each."""
    rows = []
    for height in options.height_m or (np.nan,):
        for pitch in pitches_within(options.pitch_deg).tolist():
            done = audit(height_m=options.height_m and (height,), pitch_deg=(pitch, pitch))
            rows.append((height, pitch, done.share, *done.interval, len(done.views)))
    return pd.DataFrame(rows, columns=["height_m", "pitch_deg", "share", "share_low", "share_high", "views"])
