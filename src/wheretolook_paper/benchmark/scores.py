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

from wheretolook.dataset.config import THRESHOLDS, threshold_key
from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import TableError
from wheretolook_paper.benchmark.files import IMAGE_ENDING, ErrorFile, PoseFile

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
