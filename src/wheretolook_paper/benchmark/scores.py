"""The benchmark's two measures, as its scripts compute them ("as shipped") and joined by id ("mended").

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

import numpy as np
from numpy.typing import NDArray

from wheretolook.dataset.thresholds import THRESHOLDS, threshold_key
from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import TableError
from wheretolook_paper.benchmark.files import IMAGE_ENDING, ErrorFile, PoseFile

PLAN_THRESHOLD = (0.25, 2.0)
PLAN_TURN_DEG = 30.0
PLAN = f"plan_{threshold_key(PLAN_THRESHOLD)}_turn{PLAN_TURN_DEG:g}deg"
MEASURES = (*(threshold_key(threshold) for threshold in THRESHOLDS), PLAN)
"""Names of the measures: those of evaluate_loc, and that of evaluate_plan."""


@dataclass(frozen=True)
class Share:
    """A count and its total."""

    hits: int
    total: int

    @property
    def percent(self) -> float:
        """Hits in percent of the total; NaN without a total."""
        return 100 * self.hits / self.total if self.total else float("nan")

    def __add__(self, other: Share) -> Share:
        return Share(self.hits + other.hits, self.total + other.total)

    def __str__(self) -> str:
        return f"{self.hits}/{self.total} ({self.percent:.2f} %)"


@dataclass(frozen=True, eq=False)
class Scores:
    """Poses of a method, their errors, and both versions of the measures; arrays are in the order of the poses."""

    poses: PoseFile
    metres: Float  # (N,) joined by id; NaN without a pose or a line
    degrees: Float  # (N,)
    turns_deg: Float  # (N,) rotation from the previous pose
    by_row: NDArray[np.int64] | None  # (N,) row of the errors that evaluate_plan.py takes; None where it stops
    errors: ErrorFile
    mended: dict[str, Share]
    as_shipped: dict[str, Share | None]  # None where the script stops

    @classmethod
    def of(cls, poses: PoseFile, errors: ErrorFile) -> Scores:
        """Join poses and errors and measure both ways. Raises a TableError for an error without a pose."""
        rows = _join(poses.ids, errors)
        found = rows >= 0
        metres, degrees = (np.where(found, values[rows], np.nan) for values in (errors.metres, errors.degrees))
        turns = turns_deg(poses.quaternions)
        by_row = np.arange(len(poses)) if len(poses) == len(errors) else None
        shipped: dict[str, Share | None] = dict(evaluate_loc(errors.metres, errors.degrees))
        shipped[PLAN] = None if by_row is None else evaluate_plan(errors.metres, errors.degrees, turns)
        mended = evaluate_loc(metres, degrees) | {PLAN: evaluate_plan(metres, degrees, turns)}
        return cls(poses, metres, degrees, turns, by_row, errors, mended, shipped)


def evaluate_loc(metres: Float, degrees: Float) -> dict[str, Share]:
    """Return the shares of errors (N,) in metres and degrees within each threshold, by `threshold_key`."""
    return {
        threshold_key(limits): Share(int(within(metres, degrees, limits).sum()), len(metres)) for limits in THRESHOLDS
    }


def evaluate_plan(metres: Float, degrees: Float, turns: Float) -> Share:
    """Return the share of poses by errors (N,) in metres and degrees and rotations (N,) from the previous pose."""
    return Share(int(planned(metres, degrees, turns).sum()), len(metres))


def within(metres: Float, degrees: Float, limits: tuple[float, float]) -> NDArray[np.bool_]:
    """Return which errors (N,) are within limits in metres and degrees; NaN is not."""
    return np.asarray((metres <= limits[0]) & (degrees <= limits[1]))


def planned(metres: Float, degrees: Float, turns: Float) -> NDArray[np.bool_]:
    """Return which poses (N,) count in `evaluate_plan`."""
    return within(metres, degrees, PLAN_THRESHOLD) & (turns <= PLAN_TURN_DEG)


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
    used = found[found >= 0]
    if len(np.unique(used)) < len(used) or len(used) < len(errors):
        strange = next((name for row, name in enumerate(errors.ids) if row not in used), "two poses with one error")
        fix = "Give the errors of these very poses."
        raise TableError("the errors do not belong to the poses", value=strange, fix=fix)
    return found
