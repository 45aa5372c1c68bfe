"""How much of a place localizes from a map alone: shares of target views, weak regions with their causes, mounts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from wheretolook.evaluation.statistics import ClusterBootstrap
from wheretolook.extend.config import TargetOptions
from wheretolook.extend.places import camera_places, drawn_views, pitches_within
from wheretolook.extend.surface import mapping_views
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.geometry.views import Views
from wheretolook.inputs.landmark_features import ReasonCounter
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import is_probability
from wheretolook.utils.errors import ConfigError

CAUSES = {"n_too_far": "too far", "n_too_oblique": "too oblique", "n_repeated": "repeated"}


@dataclass(frozen=True, eq=False)
class Audit:
    """Target views of a place, scored on a map.

    Attributes:
        views: the target views, in the world; `waypoint` is the row of the place.
        apart_m: how far neighbouring places are apart.
    """

    views: Views
    apart_m: float

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

    def on(self, scorer: Scorer) -> Audit:
        """Score the same views on another map in the same frame."""
        in_map = self.views.frame.world_from_map.inverse.apply_to_poses(self.views.cam_from_world)
        poses = scorer.localization_map.frame.world_from_map.apply_to_poses(in_map)
        return replace(self, views=_scored(scorer, replace(self.views, cam_from_world=poses)))

    def of_places(self) -> pd.DataFrame:
        """Return a row for each place: its location in the map, the share there, and the weak region and its cause."""
        views = self.views
        frame = views.frame
        positions = frame.world_from_map.inverse.apply(views.positions)
        table = pd.DataFrame({"place": views.waypoint, "name": views.waypoint_id, "share": views.score})
        table[["x", "y", "z"]] = positions
        reasons = [*CAUSES, "n_occluded", "n_visible"]
        table[reasons] = np.column_stack([getattr(views, name) for name in reasons])
        columns = {"name": "first", "x": "first", "y": "first", "z": "first", "share": "mean"}
        places = table.groupby("place").agg({**columns, **dict.fromkeys(reasons, "mean")}).reset_index(drop=True)
        places.insert(4, "n_views", table.groupby("place").size().to_numpy())
        weak = np.flatnonzero(places["share"] < 0.5)
        at = frame.world_from_map.apply(places[["x", "y", "z"]].to_numpy())
        near = cKDTree(at[weak]).sparse_distance_matrix(cKDTree(at[weak]), 1.6 * self.apart_m)
        region = connected_components(near, directed=False)[1] if len(weak) else np.empty(0, dtype=np.int64)
        lost = np.bincount(region, 1 - places["share"].to_numpy()[weak])
        number = np.empty(len(lost), dtype=np.int64)
        number[np.argsort(-lost, kind="stable")] = 1 + np.arange(len(lost))
        places["region"] = 0
        places.loc[weak, "region"] = number[region]
        places["cause"] = ""
        usual = float(places["n_visible"].drop(index=weak).median()) if len(weak) < len(places) else 200.0
        for of_region in range(1, len(lost) + 1):
            rows = places["region"] == of_region
            places.loc[rows, "cause"] = _cause(places[rows], usual)
        return places

    def regions(self) -> list[dict[str, Any]]:
        """Return the weak regions as records, that with most views lost first."""
        records = []
        for number, part in self.of_places().query("region > 0").groupby("region"):
            center = part[["x", "y", "z"]].mean().round(3).tolist()
            share = float((part["share"] * part["n_views"]).sum() / part["n_views"].sum())
            shares = {name: float(part[name].sum() / max(part["n_visible"].sum(), 1)) for name in CAUSES}
            record = {"region": number, "cause": part["cause"].iloc[0], "center": center, "places": len(part)}
            records.append({**record, "share": share, "n_visible": float(part["n_visible"].mean()), **shares})
        return records

    def record(self) -> dict[str, Any]:
        """Return all numbers as JSON values."""
        return {
            "share": self.share,
            "share_interval": [None if value != value else value for value in self.interval],
            "views": len(self.views),
            "places": len({*self.views.waypoint.tolist()}),
            "method": self.views.method,
            "scale": self.views.frame.scale.source,
            "regions": self.regions(),
        }


def _cause(places: pd.DataFrame, usual: float) -> str:
    """Return why a region is weak: few landmarks are visible, or most of them are hard to match."""
    if places["n_visible"].mean() < 0.2 * usual:
        return "nothing mapped"
    shares = {name: float(places[name].sum() / max(places["n_visible"].sum(), 1)) for name in CAUSES}
    worst = max(shares, key=lambda name: np.nan_to_num(shares[name]))
    return CAUSES[worst] if shares[worst] > 0.3 else "few landmarks"


def audit_places(
    scorer: Scorer,
    places: Float,
    names: Sequence[str],
    heading_deg: Float | None,
    options: TargetOptions,
    apart_m: float,
) -> Audit:
    """Score target views at places (W, 3) in the world.

    Raises ConfigError if the scores are no probabilities.
    """
    if not is_probability(scorer.name):
        fix = "Use the method set, or weights of another learned method."
        raise ConfigError("the scores of this method are no probabilities", value=scorer.name, fix=fix)
    pitches = pitches_within(options.pitch_deg)
    pan = options.pan_deg or (-180.0, 180.0)
    poses, rows = drawn_views(places, options.views, pitches, heading_deg, pan, options.seed)
    ids = tuple(names[row] for row in rows)
    return Audit(_scored(scorer, Views(poses, waypoint=rows, waypoint_id=ids)), apart_m)


def _scored(scorer: Scorer, views: Views) -> Views:
    """Return views in the world of the scorer's map with its report and the numbers of landmarks that are hard to match."""
    localization_map = scorer.localization_map
    reasons = ReasonCounter(localization_map)
    poses = views.cam_from_world
    step = max(1, (1 << 24) // max(1, len(localization_map.landmarks)))  # lines of sight tested at once
    parts = []
    for begin in range(0, len(poses), step):
        block = poses[begin : begin + step]
        parts.append(replace(scorer.report(block), **reasons.count(block).columns))
    scored = Views.concatenate(parts)
    return replace(scored, waypoint=views.waypoint, waypoint_id=views.waypoint_id, frame=localization_map.frame)


def free_places(scorer: Scorer, space: Any, options: TargetOptions, most: int) -> tuple[Float, float]:
    """Return places where a camera can be at the heights of the options, as `camera_places`."""
    centers = camera_centers(mapping_views(scorer.localization_map)[0])
    found = [camera_places(space, centers, height, most) for height in options.height_m or (None,)]
    return np.concatenate([places for places, _ in found]), max(apart for _, apart in found)


def compare_mounts(audit: Callable[..., Audit], options: TargetOptions) -> pd.DataFrame:
    """Audit each height and pitch of the options, by a function that takes them, for a fixed camera: a row of each."""
    rows = []
    for height in options.height_m or (None,):
        for pitch in pitches_within(options.pitch_deg).tolist():
            done = audit(height_m=() if height is None else (height,), pitch_deg=(pitch, pitch))
            low, high = done.interval
            row = {"height_m": np.nan if height is None else height, "pitch_deg": pitch, "share": done.share}
            rows.append({**row, "share_low": low, "share_high": high, "views": len(done.views)})
    return pd.DataFrame(rows)
