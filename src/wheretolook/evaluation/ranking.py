"""How many of each location's best-scored views are good, and how many could be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from wheretolook.geometry.poses import Float


@dataclass(frozen=True, eq=False)
class TestViews:
    """Labelled views to choose from."""

    __test__ = False  # no test class, whatever its name says

    location: NDArray[np.int64]  # (B,) int64, number of each view's location, 0 .. L-1 over all scenes
    viewpoint_id: NDArray[np.int64]  # (B,) int64, unique within a location
    good: NDArray[np.bool_]  # (B, T) bool, whether the view localizes within each of T thresholds
    location_scene: NDArray[np.int64]  # (L,) int64, number of each location's scene
    # (L,) int64, number of the block of neighbouring locations that each is resampled with, see
    # `wheretolook.evaluation.bootstrap.ClusterBootstrap`; None for each by itself
    location_block: NDArray[np.int64] | None = None

    @property
    def n_locations(self) -> int:
        """L."""
        return len(self.location_scene)

    def only(self, mask: NDArray[np.bool_]) -> TestViews:
        """The views where `mask` (B,) is set, in the same order.

        Locations without any are left out and the others renumbered, in the same order; scenes keep their numbers.
        """
        kept, location = np.unique(self.location[mask], return_inverse=True)
        block = None if self.location_block is None else self.location_block[kept]
        return TestViews(location, self.viewpoint_id[mask], self.good[mask], self.location_scene[kept], block)


@dataclass(frozen=True, eq=False)
class TopN:
    """What the views chosen at each location are worth."""

    chosen: Float  # (L,) views chosen at each location: N, or all there are
    good: Float  # (L, T) how many of them are good within each threshold (an expectation for random choice)
    any_good: Float  # (L, T) whether at least one is (a probability for random choice)


def rank_views(views: TestViews, scores: Float) -> NDArray[np.int64]:
    """Rank (B,) of every view within its location by scores (B,), 0 the highest; of equals the smaller viewpoint_id."""
    order = np.lexsort((views.viewpoint_id, -scores, views.location))
    location = views.location[order]
    first = np.searchsorted(location, np.arange(views.n_locations))
    ranks = np.empty(len(order), dtype=np.int64)
    ranks[order] = np.arange(len(order)) - first[location]
    return ranks


def choose_best(views: TestViews, ranks: NDArray[np.int64], n: int) -> TopN:
    """Choose the n views of every location that rank first (`rank_views`); where there are fewer, all."""
    good = _sum_by_location(views, views.good & (ranks < n)[:, None])
    return TopN(np.minimum(_n_views(views), n), good, (good > 0).astype(np.float64))


def choose_by_truth(views: TestViews, n: int) -> TopN:
    """The oracle: for each threshold the N views of every location that are best by it. No choice of N does better."""
    good = np.minimum(_sum_by_location(views, views.good), n)
    return TopN(np.minimum(_n_views(views), n), good, (good > 0).astype(np.float64))


def choose_at_random(views: TestViews, n: int) -> TopN:
    """The exact expectation of choosing N views of every location uniformly at random, without replacement.

    With g good views of m, min(N, m) g / m of the chosen ones are good, and at least one is with probability
    1 - C(m - g, N) / C(m, N) (hypergeometric).
    """
    total = _n_views(views)[:, None]
    good = _sum_by_location(views, views.good)
    chosen = np.minimum(total, n)
    none_possible = total - good >= chosen
    bad = np.where(none_possible, total - good, chosen)
    log_none = gammaln(bad + 1) - gammaln(bad - chosen + 1) - gammaln(total + 1) + gammaln(total - chosen + 1)
    none = np.where(none_possible, np.exp(log_none), 0.0)
    return TopN(chosen[:, 0], chosen * good / total, 1 - none)


def _n_views(views: TestViews) -> Float:
    return np.bincount(views.location, minlength=views.n_locations).astype(np.float64)


def _sum_by_location(views: TestViews, flags: NDArray[np.bool_]) -> Float:
    columns = [np.bincount(views.location, weights=column, minlength=views.n_locations) for column in flags.T]
    return np.stack(columns, axis=-1)
