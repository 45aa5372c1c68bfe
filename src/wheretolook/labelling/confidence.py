"""How sure it is that a joint pose is right: what a robot knows of it without knowing where it is.

A wrong pose can have a hundred inliers where the map resembles itself. But then another place has nearly as many, and
the pose that is right is the one that explains all looks much better than any pose elsewhere.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float
from wheretolook.utils.logistic import LogisticRegression

if TYPE_CHECKING:
    from wheretolook.labelling.joint import JointLocalization

SHIPPED = Path(__file__).with_name("confidence.json")

TOLD = ("log_inliers", "log_elsewhere", "log_share", "log_deviation_m", "log_deviation_deg")
"""What the confidence goes by: log(1 + inliers), log(1 + support of the best pose elsewhere), log of the share of
matches that are inliers, log of one standard deviation of position (m) and of orientation (degrees)."""

MIN_INLIERS = 10  # with fewer the localizer itself refuses a pose

LEAST_DEVIATION, MOST_DEVIATION = 1e-4, 10.0  # metres and degrees, beyond which it makes no difference


def told_numbers(
    n_inliers: ArrayLike, n_matches: ArrayLike, elsewhere: ArrayLike, deviation_m: ArrayLike, deviation_deg: ArrayLike
) -> Float:
    """`TOLD` (B, 5) of B joint poses."""
    inliers, matches, rival = (np.asarray(x, dtype=np.float64) for x in (n_inliers, n_matches, elsewhere))
    off = [
        np.clip(np.asarray(x, dtype=np.float64), LEAST_DEVIATION, MOST_DEVIATION) for x in (deviation_m, deviation_deg)
    ]
    share = np.log((inliers + 0.5) / (matches + 1))
    return np.stack([np.log1p(inliers), np.log1p(rival), share, np.log(off[0]), np.log(off[1])], axis=-1)


class Confidence(LogisticRegression):
    """The probability that a pose is within 5 cm and 0.4 degrees; 0 with fewer inliers than `MIN_INLIERS`."""

    names, about, file = TOLD, "confidence", SHIPPED

    def of(self, found: JointLocalization) -> float:
        """The confidence in a joint pose, 0 where there is none."""
        return float(self.of_numbers(found.n_inliers, found.n_matches, found.elsewhere, *found.deviation))

    def of_numbers(
        self, n_inliers: ArrayLike, n_matches: ArrayLike, elsewhere: ArrayLike, deviation_m: ArrayLike,
        deviation_deg: ArrayLike,
    ) -> Float:  # fmt: skip
        """Confidences (B,) from the numbers of `told_numbers`."""
        sure = self.probabilities(told_numbers(n_inliers, n_matches, elsewhere, deviation_m, deviation_deg))
        return np.where(np.asarray(n_inliers) >= MIN_INLIERS, sure, 0.0)
