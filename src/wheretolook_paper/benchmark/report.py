"""Tables of a round: a row per view, and the summary of both versions of the measures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from wheretolook.dataset.config import ALL, threshold_key, threshold_label
from wheretolook.geometry.poses import camera_centers, pan_tilt_angles
from wheretolook.utils.files import write_text
from wheretolook.utils.texts import markdown_table
from wheretolook_paper.benchmark.scores import PLAN, PLAN_THRESHOLD, PLAN_TURN_DEG, Scores

VIEWS_CSV = "views.csv"
SUMMARY_CSV = "summary.csv"

NOTES = """\
As shipped: the benchmark's scripts on these files. `evaluate_plan.py` takes the n-th line of the errors for the n-th
pose, though errors stand in the order of file names (1, 10, 2) and poses in that of waypoints, and stops where their
numbers differ. Mended: joined by id; a pose without an error has failed. Shares over all scenes are of all views, not
means of scenes. No oracle: some waypoints may have no view that localizes."""

_VERSIONS = ("as_shipped", "mended")


@dataclass(frozen=True, eq=False)
class Result:
    """The scores of a method in a scene."""

    scene: str
    method: str
    scores: Scores

    def views(self) -> pd.DataFrame:
        """Return a row per view: direction, error, rotation, and the measures in which it counts.

        `as_shipped_error_of` is the id whose error evaluate_plan.py takes for the view, `as_shipped_plan` the result;
        both are empty where the script stops.
        """
        scores = self.scores
        poses = scores.poses.cam_from_world
        (yaw, pitch) = np.degrees(pan_tilt_angles(poses[:, 2, :3]))
        columns: dict[str, Any] = {"scene": self.scene, "method": self.method, "id": scores.poses.ids}
        columns |= dict(zip("xyz", camera_centers(poses).T, strict=True))
        columns |= {"yaw_deg": yaw, "pitch_deg": pitch}
        columns |= {"error_m": scores.metres, "error_deg": scores.degrees, "turn_deg": scores.turns_deg}
        columns |= {measure: counts.astype(int) for measure, counts in scores.mended.items()}
        planned = scores.as_shipped.get(PLAN)
        columns["as_shipped_error_of"] = "" if planned is None else scores.errors.ids
        columns["as_shipped_plan"] = "" if planned is None else planned.astype(int)
        return pd.DataFrame(columns)


def summary_table(results: Sequence[Result]) -> pd.DataFrame:
    """Return a row per scene, method and measure with hits, total and percent of both versions; `ALL` scenes last.

    A script that stops in one scene has no result, NA, there and over all scenes.
    """
    rows = []
    for result in results:
        for measure in result.scores.mended:
            row: dict[str, Any] = {"scene": result.scene, "method": result.method, "measure": measure}
            for version in _VERSIONS:
                counts = getattr(result.scores, version).get(measure)
                row[f"{version}_hits"] = None if counts is None else int(counts.sum())
                row[f"{version}_total"] = None if counts is None else len(counts)
            rows.append(row)
    counted = {f"{version}_{name}": "Int64" for version in _VERSIONS for name in ("hits", "total")}
    table = pd.DataFrame(rows).astype(counted)
    if table["scene"].nunique() > 1:
        pooled = table.groupby(["method", "measure"], sort=False)[[*counted]].agg(pd.Series.sum, skipna=False)
        table = pd.concat([table, pooled.reset_index().assign(scene=ALL)], ignore_index=True)
    for version in _VERSIONS:
        percent = 100 * table[f"{version}_hits"] / table[f"{version}_total"]
        table[f"{version}_percent"] = percent.astype(float)
    numbers = [f"{version}_{name}" for version in _VERSIONS for name in ("hits", "total", "percent")]
    return table[["scene", "method", "measure", *numbers]]


def summary_text(summary: pd.DataFrame) -> str:
    """Format the summary as Markdown."""
    rows = []
    for row in summary.to_dict("records"):
        plan = f"plan: {threshold_label(threshold_key(PLAN_THRESHOLD))}, turn {PLAN_TURN_DEG:g}°"
        cells = [row["scene"], row["method"], plan if row["measure"] == PLAN else threshold_label(row["measure"])]
        for hits, total, percent in ([row[f"{v}_{name}"] for name in ("hits", "total", "percent")] for v in _VERSIONS):
            cells.append("stops" if pd.isna(hits) else f"{hits}/{total} ({percent:.2f} %)")
        rows.append(cells)
    return markdown_table(["scene", "method", "error at most", "as shipped", "mended"], rows)


def write_report(results: Sequence[Result], folder: Path) -> str:
    """Write `views.csv`, `summary.csv` and `summary.md` into a folder; return the summary's text."""
    summary = summary_table(results)
    text = summary_text(summary)
    views = pd.concat([result.views() for result in results], ignore_index=True)
    write_text(folder / VIEWS_CSV, views.to_csv(index=False, float_format="%.6g", lineterminator="\n"))
    write_text(folder / SUMMARY_CSV, summary.to_csv(index=False, float_format="%.4f", lineterminator="\n"))
    write_text(folder / "summary.md", f"# Active Localization Benchmark\n\n{text}\n\n{NOTES}\n")
    return text
