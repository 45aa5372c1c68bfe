"""Random scores: the baseline that every method must beat."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float, check_poses
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import rule

if TYPE_CHECKING:
    from wheretolook.inputs.localization_map import LocalizationMap


class RandomScorer(Scorer):
    """Uniform random scores, a function of pose and seed."""

    name = "random"

    def __init__(self, localization_map: LocalizationMap, seed: int = 0) -> None:
        super().__init__(localization_map)
        self.seed = seed

    def score(self, cam_from_world: Float) -> Float:
        """(B,) in [0, 1)."""
        return uniform(check_poses(cam_from_world).reshape(-1, 12), self.seed)


def uniform(values: Float, seed: int) -> Float:
    """Return uniform numbers (B,) in [0, 1), a function of rows (B, K), to six decimals, and the seed."""
    numbers = np.round(values * 1e6).astype(np.int64)
    state = np.full(len(numbers), seed, dtype=np.uint64)
    for column in numbers.T:
        state = _splitmix64(state ^ column.astype(np.uint64))
    return np.asarray((state >> np.uint64(11)).astype(np.float64) * 2.0**-53)


def _splitmix64(state: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """One step of the SplitMix64 generator (Steele et al., OOPSLA 2014), which mixes all bits."""
    state = state + np.uint64(0x9E3779B97F4A7C15)
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


METHODS = (rule(RandomScorer, build=lambda map, options: RandomScorer(map, options.seed)),)
