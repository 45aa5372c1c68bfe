"""Tables of a round: a row per view, and the summary of both versions of the measures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from wheretolook.dataset.thresholds import ALL, THRESHOLDS, threshold_key, threshold_label
from wheretolook.geometry.camera_turns import pan_tilt_angles
from wheretolook.geometry.poses import camera_centers
from wheretolook.utils.files import write_text
from wheretolook.utils.markdown import markdown_table
from wheretolook_paper.benchmark.scores import (
    MEASURES,
    PLAN,
    PLAN_THRESHOLD,
    PLAN_TURN_DEG,
    Scores,
    Share,
    planned,
    within,
)

VIEWS_CSV = "views.csv"
SUMMARY_CSV = "summary.csv"
SUMMARY_MD = "summary.md"

NOTES = """\
As shipped: the benchmark's scripts on these files. `evaluate_plan.py` takes the n-th line of the errors for the n-th
pose, though errors stand in the order of file names (1, 10, 2) and poses in that of waypoints, and stops where their
numbers differ. Mended: joined by id; a pose without an error has failed. Shares over all scenes are of all views, not
means of scenes. No oracle: some waypoints may have no view that localizes."""


@dataclass(frozen=True, eq=False)
class Result:
    """The scores of a method in a scene."""

    scene: str
    method: str
    scores: Scores


def views_table(results: Sequence[Result]) -> pd.DataFrame:
    """Return a row per view: direction, error, rotation, and the measures in which it counts.

    `as_shipped_error_of` is the id whose error evaluate_plan.py takes for the view, `as_shipped_plan` the result; both
    are empty where the script stops.
    """
    return pd.concat([_views(result) for result in results], ignore_index=True)


def _views(result: Result) -> pd.DataFrame:
    scores = result.scores
    poses = result.scores.poses.cam_from_world
    centers = camera_centers(poses)
    (yaw, pitch) = pan_tilt_angles(poses[:, 2, :3])
    columns: dict[str, Any] = {"scene": result.scene, "method": result.method, "id": scores.poses.ids}
    columns |= dict(zip("xyz", centers.T, strict=True))
    columns |= {"yaw_deg": np.degrees(yaw), "pitch_deg": np.degrees(pitch)}
    columns |= {"error_m": scores.metres, "error_deg": scores.degrees, "turn_deg": scores.turns_deg}
    for limits in THRESHOLDS:
        columns[threshold_key(limits)] = within(scores.metres, scores.degrees, limits).astype(int)
    columns[PLAN] = planned(scores.metres, scores.degrees, scores.turns_deg).astype(int)
    if scores.by_row is None:
        return pd.DataFrame(columns | {"as_shipped_error_of": "", "as_shipped_plan": ""})
    errors = scores.errors
    rows = scores.by_row
    columns["as_shipped_error_of"] = [errors.ids[row] for row in rows]
    columns["as_shipped_plan"] = planned(errors.metres[rows], errors.degrees[rows], scores.turns_deg).astype(int)
    return pd.DataFrame(columns)


def summary_table(results: Sequence[Result]) -> pd.DataFrame:
    """Return a row per scene, method and measure with hits, total and percent of both versions; `ALL` scenes last.

    A script that stops in one scene has no result over all scenes.
    """
    groups: dict[tuple[str, str], list[Scores]] = {}
    several = len({result.scene for result in results}) > 1
    for scene_of in (lambda result: result.scene, *([lambda result: ALL] if several else [])):
        for result in results:
            groups.setdefault((scene_of(result), result.method), []).append(result.scores)
    rows = []
    for (scene, method), scores in groups.items():
        for measure in MEASURES:
            row: dict[str, Any] = {"scene": scene, "method": method, "measure": measure}
            for version in ("as_shipped", "mended"):
                shares = [getattr(one, version)[measure] for one in scores]
                share = None if None in shares else sum(shares, Share(0, 0))
                values = ("", "", "") if share is None else (share.hits, share.total, share.percent)
                row |= dict(zip((f"{version}_{name}" for name in ("hits", "total", "percent")), values, strict=True))
            rows.append(row)
    return pd.DataFrame(rows)


def summary_text(summary: pd.DataFrame) -> str:
    """Format the summary as Markdown."""
    rows = []
    for row in summary.to_dict("records"):
        cells = [row["scene"], row["method"], measure_label(row["measure"])]
        for version in ("as_shipped", "mended"):
            hits = row[f"{version}_hits"]
            cells.append("stops" if hits == "" else str(Share(int(hits), int(row[f"{version}_total"]))))
        rows.append(cells)
    return markdown_table(["scene", "method", "error at most", "as shipped", "mended"], rows)


def measure_label(measure: str) -> str:
    """Return the label of a measure."""
    if measure == PLAN:
        return f"plan: {threshold_label(threshold_key(PLAN_THRESHOLD))}, turn {PLAN_TURN_DEG:g}°"
    return threshold_label(measure)


def write_report(results: Sequence[Result], folder: Path) -> str:
    """Write the tables into a folder; return the summary's text."""
    summary = summary_table(results)
    text = summary_text(summary)
    write_text(folder / VIEWS_CSV, views_table(results).to_csv(index=False, float_format="%.6g", lineterminator="\n"))
    write_text(folder / SUMMARY_CSV, summary.to_csv(index=False, float_format="%.4f", lineterminator="\n"))
    write_text(folder / SUMMARY_MD, f"# Active Localization Benchmark\n\n{text}\n\n{NOTES}\n")
    return text
