"""Tables of a round: a row per view, and the benchmark's two measures, as its scripts compute them and "mended".

`evaluate_loc.py`: the share of poses with an error of at most 5 cm and 0.4°, 25 cm and 2°, 50 cm and 5°, 5 m and 10°.
`evaluate_plan.py`: the share of poses with an error of at most 25 cm and 2° that the camera turned to by at most 30°
from the previous pose, 0° for the first. A missing pose counts as a failure. All limits are inclusive.

As shipped, `evaluate_plan.py` takes the n-th line of the errors for the n-th line of the poses. Errors are written in
the order of the images' names (1, 10, 2), poses in the order of waypoints, so errors and rotations of different poses
are combined unless ids sort alike. It stops if there are more poses than errors. `evaluate_loc.py` divides by the
number of lines.
Mended, errors are joined to poses by id, and a pose without a line counts as a failure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.dataset.config import ALL, THRESHOLDS, threshold_key, threshold_label
from wheretolook.geometry.poses import Float, camera_centers, pan_tilt_angles
from wheretolook.utils.errors import TableError
from wheretolook.utils.files import write_text
from wheretolook.utils.texts import markdown_table
from wheretolook_paper.benchmark.files import IMAGE_ENDING, ErrorFile, PoseFile

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


PLAN_THRESHOLD = (0.25, 2.0)
PLAN_TURN_DEG = 30.0
PLAN = f"plan_{threshold_key(PLAN_THRESHOLD)}_turn{PLAN_TURN_DEG:g}deg"

Successes = dict[str, NDArray[np.bool_]]
"""Masks (N,) of poses that count as a success, by measure: the thresholds of evaluate_loc, `PLAN` of evaluate_plan."""


@dataclass(frozen=True, eq=False)
class Scores:
    """Poses of a method, their errors, and both versions of the measures."""

    poses: PoseFile
    errors: ErrorFile
    metres: Float  # (N,) in the order of the poses, joined by id; NaN without a pose or a line
    degrees: Float  # (N,) likewise
    turns_deg: Float  # (N,) rotation from the previous pose

    @classmethod
    def of(cls, poses: PoseFile, errors: ErrorFile) -> Scores:
        """Join poses and errors. Raises a TableError for an error without a pose."""
        rows = _join(poses.ids, errors)
        metres, degrees = (np.where(rows >= 0, values[rows], np.nan) for values in (errors.metres, errors.degrees))
        return cls(poses, errors, metres, degrees, turns_deg(poses.quaternions))

    @property
    def mended(self) -> Successes:
        """The successes in the order of the poses, joined by id."""
        return _successes(self.metres, self.degrees, self.turns_deg)

    @property
    def as_shipped(self) -> Successes:
        """The successes in the order of the errors; without `PLAN` where evaluate_plan.py stops."""
        stops = len(self.poses.ids) != len(self.errors.ids)
        return _successes(self.errors.metres, self.errors.degrees, None if stops else self.turns_deg)


def _successes(metres: Float, degrees: Float, turns: Float | None) -> Successes:
    def within(limits: tuple[float, float]) -> NDArray[np.bool_]:
        return np.asarray((metres <= limits[0]) & (degrees <= limits[1]))

    found = {threshold_key(limits): within(limits) for limits in THRESHOLDS}
    return found if turns is None else {**found, PLAN: within(PLAN_THRESHOLD) & (turns <= PLAN_TURN_DEG)}


def turns_deg(quaternions: Float) -> Float:
    """Return rotation angles (N,) in degrees from the previous orientation, 0 for the first, of quaternions (N, 4).

    Computed one by one as in evaluate_plan.py, so that an angle of 30 degrees is on the same side of the limit.
    """
    turns = np.zeros(len(quaternions))
    for row in range(1, len(quaternions)):
        (w, x, y, z) = (-quaternions[row - 1]).tolist()
        (aw, ax, ay, az) = quaternions[row].tolist()
        w = -w  # conjugate of the previous quaternion; Hamilton's product with it is the relative rotation
        vector = [
            aw * x + ax * w + ay * z - az * y,
            aw * y - ax * z + ay * w + az * x,
            aw * z + ax * y - ay * x + az * w,
        ]
        real = aw * w - ax * x - ay * y - az * z
        angle = 2 * np.arctan2(np.linalg.norm(vector), np.clip(real, -1.0, 1.0))
        turns[row] = np.degrees(2 * np.pi - angle if angle > np.pi else angle)
    return turns


def _join(ids: Sequence[str], errors: ErrorFile) -> NDArray[np.int64]:
    """Return the row of the errors for each id, -1 for none.

    match_and_localize.py strips the characters of ".png" from both ends of a name.
    """
    rows = {name: row for row, name in enumerate(errors.ids)}
    found = np.array([rows.get(name, rows.get(name.strip(IMAGE_ENDING), -1)) for name in ids], dtype=np.int64)
    if sorted(found[found >= 0]) != list(range(len(errors.ids))):
        raise TableError("the errors do not belong to the poses", fix="Give the errors of these very poses.")
    return found
