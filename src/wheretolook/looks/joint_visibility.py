"""What several looks from a place can be expected to find together.

Looks add up: a landmark is found by a set of looks if one of them finds it, with a chance of 1 - prod(1 - p) over the
looks' own chances; what the found ones tell of the pose is summed in the world's axes, which all looks share. As
sums over landmarks, they serve sets of any size as they serve one view (`methods/set/network.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.pose_information import N_NUMBERS, bearing_numbers, information_matrices
from wheretolook.geometry.poses import Float, poses_looking_along

if TYPE_CHECKING:
    from wheretolook.scorers.base import Scorer

N_SUMS = 1 + N_NUMBERS  # landmarks expected to be found, and the information on the pose that lies in them
PRIOR = 1e-3  # information on each coordinate before anything is seen, as of the network over the set of landmarks
MOST_ENTRIES = 12_000  # landmarks in view of all looks that are described; of more, an even share stands for all


@dataclass(frozen=True, eq=False)
class SeenAround:
    """What each of D looks from a place sees: U landmarks in all."""

    chances: NDArray[np.float32]  # (D, U) of being found by the look; 0 of those it does not see
    told: Float  # (U, N_SUMS) float64, what a landmark adds to the sums if it is found
    n_visible: NDArray[np.int64]  # (D,) landmarks in view
    alone: Float  # (D,) probability that the look localizes alone; 0 where nothing tells

    def __len__(self) -> int:
        return len(self.chances)

    def sums(self, missed: NDArray[np.float32] | None = None) -> Float:
        """Sums (D, N_SUMS) of each look, joined with looks by which landmarks are missed with chances (U,); 1 if none.

        In single precision, which choosing between looks can do with; `union` is in double.
        """
        if missed is None:
            return np.asarray((self.chances @ self.told.astype(np.float32)).astype(np.float64))
        left = missed.astype(np.float64)[:, None] * self.told
        return np.asarray(self.told.sum(0) - left.sum(0) + self.chances @ left.astype(np.float32))

    def missed(self, looks: NDArray[np.int64] | list[int]) -> NDArray[np.float32]:
        """The chance (U,) that none of some looks finds each landmark."""
        return np.asarray(np.prod(1 - self.chances[np.asarray(looks, dtype=np.int64)], axis=0), dtype=np.float32)

    def failed(self, looks: NDArray[np.int64] | list[int]) -> float:
        """The chance that none of some looks localizes alone, each for itself."""
        return float(np.prod(1 - self.alone[np.asarray(looks, dtype=np.int64)]))

    def union(self, looks: NDArray[np.int64] | list[int]) -> Float:
        """Sums (N_SUMS,) of a set of looks."""
        return np.asarray((1 - self.missed(looks).astype(np.float64)) @ self.told)


def union_plain(seen: SeenAround, looks: list[int]) -> Float:
    """What `SeenAround.union` computes, landmark by landmark."""
    sums = np.zeros(N_SUMS)
    for landmark, adds in enumerate(seen.told):
        missed = 1.0
        for look in looks:
            missed *= 1.0 - float(seen.chances[look, landmark])
        sums += (1 - missed) * adds
    return sums


def seen_around(
    scorer: Scorer, location: Float, directions: Float, scores: Float | None = None, sure: bool = False
) -> SeenAround:
    """What looks along directions (D, 3) from a location (3,) m see, by the chances that a scorer knows.

    `scores` (D,) are what it gives the looks, which count as probabilities if they are of a method whose scores are.
    A scorer that learnt chances of landmarks gives them (`set`, `expected-...`); by others, and if `sure`, every
    landmark in view counts as found, and each with the same precision.
    """
    import torch  # takes seconds to load

    from wheretolook.scorers.matchability.network import bearing_precision
    from wheretolook.scorers.registry import find
    from wheretolook.visibility.frustum import LandmarkSets

    poses = poses_looking_along(np.tile(np.asarray(location, dtype=np.float64), (len(directions), 1)), directions)
    around = scorer.localization_map
    chances_of = None if sure else _chances_of(scorer)
    starts, indices = around.in_view_on_device(poses)
    n_visible = np.diff(starts)
    rows = indices.cpu().numpy().astype(np.int64)
    of_look = np.repeat(np.arange(len(poses)), n_visible)
    stride = max(1, -(-len(rows) // MOST_ENTRIES))
    if stride > 1:  # the same landmarks for every look, so that what they share remains so
        kept = rows % stride == 0
        rows = rows[kept]
        of_look = of_look[kept]
    landmarks, column = np.unique(rows, return_inverse=True)
    chances = np.zeros((len(poses), len(landmarks)), dtype=np.float32)
    offsets = around.landmarks.points[landmarks] - np.asarray(location, dtype=np.float64)
    told = np.concatenate([np.ones((len(landmarks), 1)), bearing_numbers(offsets)], axis=1)
    if chances_of is None or len(rows) == 0:
        chances[of_look, column] = 1
    else:
        describer, log_odds = chances_of
        ends = np.concatenate([[0], np.bincount(of_look, minlength=len(poses)).cumsum()])
        with torch.inference_mode():
            described = describer.describe(poses, LandmarkSets(ends, rows.astype(np.int32)))
            chances[of_look, column] = log_odds(described.values).sigmoid().float().cpu().numpy()
            precision = bearing_precision(described.values, described.attributes)
            if precision is not None:  # the same from every look: it depends on the distance
                weight = np.ones(len(landmarks))
                weight[column] = precision.double().cpu().numpy()
                told[:, 1:] *= weight[:, None]
    alone = np.zeros(len(poses))
    method = find(scorer.name)
    if scores is not None and not sure and method is not None and method.probability:
        alone = np.clip(np.asarray(scores, dtype=np.float64), 0, 1)
    return SeenAround(chances, told * stride, n_visible, alone)


def _chances_of(scorer: Scorer) -> Any:
    """A describer of landmarks and the log-odds of their being found, of scorers that learnt these; None of others."""
    from wheretolook.scorers.set.score import SetScorer
    from wheretolook_paper.scorers.expected import ExpectedFisherScorer, ExpectedScorer

    if isinstance(scorer, SetScorer):
        return scorer.describer, scorer.network.matchability
    if isinstance(scorer, ExpectedScorer | ExpectedFisherScorer):
        return scorer.describer, scorer._expectation._log_odds
    return None


def log_position_variance(sums: Float) -> Float:
    """Of sums (..., N_SUMS): the log (...,) of the trace of the position's block of the expected covariance."""
    information = information_matrices(sums[..., 1:]) + PRIOR * np.eye(6)
    covariance = np.linalg.inv(information)
    return np.log(np.trace(covariance[..., :3, :3], axis1=-2, axis2=-1))
