"""What several views from one location can be expected to detect jointly.

A set of views detects a landmark if one of them does, with probability 1 - prod(1 - p) over the views. The information
of the detected landmarks on the pose is summed along the world's axes, which all views share. As sums over landmarks,
they serve sets of any size as they serve a single view (`scorers/set/network.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.pose_information import N_NUMBERS, PRIOR, bearing_numbers, information_matrices
from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.utils.errors import ConfigError

if TYPE_CHECKING:
    from wheretolook.scorers.base import Scorer

N_SUMS = 1 + N_NUMBERS  # landmarks expected to be detected, and their information on the pose
MAX_ENTRIES = 12_000  # visible landmarks of all views that are described; of more, an even share represents all


@dataclass(frozen=True, eq=False)
class CandidateViews:
    """What each of D views from one location detects of U landmarks."""

    p_detect: NDArray[np.float32]  # (D, U) probability that the view detects the landmark; 0 where it is not visible
    terms: Float  # (U, N_SUMS) float64, what a detected landmark adds to the sums
    n_visible: NDArray[np.int64]  # (D,) visible landmarks
    p_single: Float  # (D,) probability that the view localizes on its own; 0 where it is unknown

    def __len__(self) -> int:
        return len(self.p_detect)

    def sums_with_each(self, views: Sequence[int] = ()) -> Float:
        """Return the sums (D, N_SUMS) of a set of views with each view added, in single precision."""
        left = self.terms
        if len(views):
            left = self.p_missed(views).astype(np.float64)[:, None] * self.terms
        return np.asarray(self.terms.sum(0) - left.sum(0) + self.p_detect @ left.astype(np.float32))

    def p_missed(self, views: Sequence[int]) -> NDArray[np.float32]:
        """Return the probability (U,) that none of some views detects each landmark."""
        return np.asarray(np.prod(1 - self.p_detect[np.asarray(views, dtype=np.int64)], axis=0), dtype=np.float32)

    def p_none(self, views: Sequence[int]) -> float:
        """Return the probability that none of some views localizes on its own, if they were independent."""
        return float(np.prod(1 - self.p_single[np.asarray(views, dtype=np.int64)]))

    def joint_sums(self, views: Sequence[int]) -> Float:
        """Return the sums (N_SUMS,) of a set of views, in double precision."""
        return np.asarray((1 - self.p_missed(views).astype(np.float64)) @ self.terms)


def candidate_views(
    scorer: Scorer, location: Float, directions: Float, scores: Float | None = None, certain: bool = False
) -> CandidateViews:
    """Describe what views along directions (D, 3) from a location (3,) m detect.

    `scores` (D,) of the scorer are the views' probabilities of localizing, if its method predicts those. Where the
    scorer knows no landmark probabilities, and if `certain`, every visible landmark is detected with equal precision.
    """
    from wheretolook.scorers.registry import find
    from wheretolook.visibility.frustum import LandmarkSets

    location = np.asarray(location, dtype=np.float64)
    poses = poses_looking_along(np.tile(location, (len(directions), 1)), directions)
    localization_map = scorer.localization_map
    starts, indices = localization_map.in_view_on_device(poses)
    n_visible = np.diff(starts)
    rows = indices.cpu().numpy().astype(np.int64)
    view = np.repeat(np.arange(len(poses)), n_visible)
    stride = max(1, -(-len(rows) // MAX_ENTRIES))
    kept = rows % stride == 0  # the same landmarks for every view, so that views still share them
    rows = rows[kept]
    view = view[kept]
    landmarks, column = np.unique(rows, return_inverse=True)
    offsets = localization_map.landmarks.points[landmarks] - location
    terms = np.concatenate([np.ones((len(landmarks), 1)), bearing_numbers(offsets)], axis=1)
    p_detect = np.zeros((len(poses), len(landmarks)), dtype=np.float32)
    p_detect[view, column] = 1
    p_single = np.zeros(len(poses))
    if not certain:
        ends = np.concatenate([[0], np.bincount(view, minlength=len(poses)).cumsum()])
        known = scorer.landmark_probabilities(poses, LandmarkSets(ends, rows.astype(np.int32))) if len(rows) else None
        if known is not None:
            p_detect[view, column] = known.p_detect
            precision = np.ones(len(landmarks))
            precision[column] = known.precision  # the same from every view: it depends on the distance
            terms[:, 1:] *= precision[:, None]
        method = find(scorer.name)
        if method is not None and method.name != scorer.name:
            fix = "Leave the accuracy out for several views of a location."
            raise ConfigError("joint scores have the accuracy of the weights", value=scorer.name, fix=fix)
        if scores is not None and method is not None and method.probability:
            p_single = np.clip(np.asarray(scores, dtype=np.float64), 0, 1)
    return CandidateViews(p_detect, terms * stride, n_visible, p_single)


def log_position_variance(sums: Float) -> Float:
    """Return the log (...,) of the trace of the position's covariance from sums (..., N_SUMS)."""
    information = information_matrices(sums[..., 1:]) + PRIOR * np.eye(6)
    covariance = np.linalg.inv(information)
    return np.log(np.trace(covariance[..., :3, :3], axis1=-2, axis2=-1))
