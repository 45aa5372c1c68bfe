"""How sure it is that a joint pose is right: what a robot knows of it without knowing where it is.

A wrong pose can have a hundred inliers where the map resembles itself. But then another place has nearly as many, or
has fewer that no likeness explains; and the pose that is right explains all looks much better than any pose elsewhere.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float
from wheretolook.localization.pose_ambiguity import log_ratio
from wheretolook.utils.shipped_model import LogisticRegression

if TYPE_CHECKING:
    from wheretolook.localization.rig_localization import JointLocalization

SHIPPED = Path(__file__).with_name("confidence.json")

TOLD = ("log_elsewhere", "log_share", "log_own", "log_deviation_deg")
"""What the confidence goes by: log(1 + support of the best pose elsewhere), log of the share of matches that are
inliers, log of the ratio of what only this pose explains to what only its strongest rival does
(`likeness.log_ratio`), log of one standard deviation of the orientation (degrees)."""

MIN_INLIERS = 10  # with fewer the localizer itself refuses a pose

LEAST_DEVIATION = 1e-4  # degrees, beyond which it makes no difference
MOST_DEVIATION = 10.0


def told_numbers(
    n_inliers: ArrayLike, n_matches: ArrayLike, elsewhere: ArrayLike, own: ArrayLike, rival_own: ArrayLike,
    deviation_deg: ArrayLike,
) -> Float:  # fmt: skip
    """`TOLD` (B, 4) of B joint poses."""
    inliers, matches, rival, off = (
        np.asarray(x, dtype=np.float64) for x in (n_inliers, n_matches, elsewhere, deviation_deg)
    )
    share = (inliers + 0.5) / (matches + 1)
    off = np.clip(off, LEAST_DEVIATION, MOST_DEVIATION)
    return np.stack([np.log1p(rival), np.log(share), log_ratio(own, rival_own), np.log(off)], axis=-1)


class Confidence(LogisticRegression):
    """The probability that a pose is within 5 cm and 0.4 degrees; 0 with fewer inliers than `MIN_INLIERS`."""

    names = TOLD
    about = "confidence"
    file = SHIPPED

    def of(self, found: JointLocalization) -> float:
        """The confidence in a joint pose, 0 where there is none."""
        return float(self.of_numbers(found.n_inliers, found.n_matches, found.elsewhere, *found.own, found.deviation[1]))

    def of_numbers(
        self, n_inliers: ArrayLike, n_matches: ArrayLike, elsewhere: ArrayLike, own: ArrayLike, rival_own: ArrayLike,
        deviation_deg: ArrayLike,
    ) -> Float:  # fmt: skip
        """Confidences (B,) from the numbers of `told_numbers`."""
        sure = self.probabilities(told_numbers(n_inliers, n_matches, elsewhere, own, rival_own, deviation_deg))
        return np.where(np.asarray(n_inliers) >= MIN_INLIERS, sure, 0.0)
