"""Choose the best-scored views of each location and count how many of them localize."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import gammaln

from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.viewpoint_table import by_first, has_first, is_good, poses
from wheretolook.evaluation.config import EvaluateConfig, candidates_label
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.utils.errors import TableError

Ids = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RankedViews:
    """B labelled views at L locations to choose from.

    Attributes:
        location: (B,) number of each view's location, 0 .. L-1 over all scenes.
        viewpoint_id: (B,) unique within a location.
        good: (B, T) whether the view localizes within each of T thresholds; (B, 2 T) by both localizers.
        location_scene: (L,) number of each location's scene.
        location_block: (L,) block of neighbouring locations that are resampled together
            (`wheretolook.evaluation.statistics.ClusterBootstrap`).
    """

    location: Ids
    viewpoint_id: Ids
    good: NDArray[np.bool_]
    location_scene: Ids
    location_block: Ids

    @property
    def n_locations(self) -> int:
        """L."""
        return len(self.location_scene)

    def only(self, mask: NDArray[np.bool_]) -> RankedViews:
        """Return the views where `mask` (B,) is set; locations are renumbered without empty ones, scenes are not."""
        kept, location = np.unique(self.location[mask], return_inverse=True)
        return RankedViews(
            location, self.viewpoint_id[mask], self.good[mask], self.location_scene[kept], self.location_block[kept]
        )


class SceneViews(NamedTuple):
    """Labelled views of one scene: B views at L locations."""

    location: Ids  # (B,) row of each view's location
    viewpoint_id: Ids  # (B,)
    good: NDArray[np.bool_]  # (B, T)
    location_id: Ids  # (L,)
    location_block: Ids  # (L,)


def join_scenes(parts: Sequence[SceneViews]) -> tuple[RankedViews, Ids]:
    """Join views of scenes, numbered in this order; also returns the location_id (L,) of each location."""
    sizes = [len(part.location_id) for part in parts]
    starts = np.cumsum([0, *sizes])
    locations, names, good, ids, blocks = zip(*parts, strict=True)
    location = np.concatenate([rows + start for rows, start in zip(locations, starts, strict=False)])
    scene = np.repeat(np.arange(len(parts)), sizes)
    views = RankedViews(location, np.concatenate(names), np.concatenate(good), scene, np.concatenate(blocks))
    return views, np.concatenate(ids)


@dataclass(frozen=True, eq=False)
class TopN:
    """Counts of the N views chosen at each of L locations; expectations and probabilities for random choice."""

    chosen: Float  # (L,) views chosen: N, or all there are
    good: Float  # (L, T) how many of them are good within each threshold
    any_good: Float  # (L, T) 1 where at least one is

    def only(self, locations: NDArray[np.bool_]) -> TopN:
        """Return the counts of the locations where the mask (L,) is set."""
        return TopN(self.chosen[locations], self.good[locations], self.any_good[locations])


def rank_views(views: RankedViews, scores: Float) -> Ids:
    """Rank views within their locations by scores (B,): (B,) from 0, the highest; ties by rising viewpoint_id."""
    order = np.lexsort((views.viewpoint_id, -scores, views.location))
    location = views.location[order]
    first = np.searchsorted(location, np.arange(views.n_locations))
    ranks = np.empty(len(order), dtype=np.int64)
    ranks[order] = np.arange(len(order)) - first[location]
    return ranks


def choose_best(views: RankedViews, ranks: Ids, n: int) -> TopN:
    """Choose the n views of every location that rank first (`rank_views`), or all where there are fewer."""
    return _top(views, _sum_by_location(views, views.good & (ranks < n)[:, None]), n)


def choose_oracle(views: RankedViews, n: int) -> TopN:
    """Choose up to n good views of every location for each threshold: the oracle."""
    return _top(views, np.minimum(_sum_by_location(views, views.good), n), n)


def _top(views: RankedViews, good: Float, n: int) -> TopN:
    return TopN(np.minimum(_n_views(views), n), good, (good > 0).astype(np.float64))


def choose_at_random(views: RankedViews, n: int) -> TopN:
    """Compute the exact expectation of choosing n views of every location uniformly, without replacement.

    With g good views of m, min(n, m) g / m of the chosen ones are good, and at least one is with probability
    1 - C(m - g, n) / C(m, n) (hypergeometric).
    """
    total = _n_views(views)[:, None]
    good = _sum_by_location(views, views.good)
    chosen = np.minimum(total, n)
    none_possible = total - good >= chosen
    bad = np.where(none_possible, total - good, chosen)
    log_none = gammaln(bad + 1) - gammaln(bad - chosen + 1) - gammaln(total + 1) + gammaln(total - chosen + 1)
    none = np.where(none_possible, np.exp(log_none), 0.0)
    return TopN(chosen[:, 0], chosen * good / total, 1 - none)


def _n_views(views: RankedViews) -> Float:
    return np.bincount(views.location, minlength=views.n_locations).astype(np.float64)


def _sum_by_location(views: RankedViews, flags: NDArray[np.bool_]) -> Float:
    columns = [np.bincount(views.location, weights=column, minlength=views.n_locations) for column in flags.T]
    return np.stack(columns, axis=-1)


@dataclass(frozen=True, eq=False)
class CandidateSet:
    """Views to choose from, under a name.

    Attributes:
        name: as in the column `candidates`: "all", or such as "best 100".
        mask: (B,) which of all labelled views belong to the set.
        views: the views of the set.
        location_id: (L,) ids of their locations, unique within a scene.
    """

    name: str
    mask: NDArray[np.bool_]
    views: RankedViews
    location_id: Ids


def views_of(
    scenes: Sequence[SceneFolder], tables: Sequence[pd.DataFrame], config: EvaluateConfig
) -> tuple[RankedViews, Ids]:
    """Return all labelled views of scenes in the order of their tables, and the location_id (L,) of each location.

    If all tables have labels by the first RANSAC result, too, these give a second half of the columns of `good`. Raises a
    TableError if a table is empty, or a viewpoint has no label.
    """
    both = all(map(has_first, tables))
    return join_scenes([_scene_views(scene, table, config, both) for scene, table in zip(scenes, tables, strict=True)])


def _scene_views(scene: SceneFolder, table: pd.DataFrame, config: EvaluateConfig, both: bool) -> SceneViews:
    if table.empty:
        raise TableError("the table has no viewpoints", path=scene.table, fix="Run the sample stage again.")
    try:
        labels = [table, *([by_first(table)] if both else [])]
        good = np.stack([is_good(one, *limits) for one in labels for limits in config.thresholds], axis=-1)
    except TableError as error:
        raise TableError(error.problem, path=scene.table, value=error.value, fix=error.fix) from None
    ids, first, rows = np.unique(table["location_id"].to_numpy(np.int64), return_index=True, return_inverse=True)
    block = np.arange(len(ids))
    if config.block_m:
        floor = camera_centers(poses(table)[first])[:, :2]
        squares = np.floor((floor - floor.min(0)) / config.block_m)
        block = np.unique(squares, axis=0, return_inverse=True)[1].reshape(-1)
    return SceneViews(rows.reshape(-1), table["viewpoint_id"].to_numpy(np.int64), good, ids, block)


def candidate_sets(
    views: RankedViews,
    location_id: Ids,
    scenes: Sequence[SceneFolder],
    tables: Sequence[pd.DataFrame],
    config: EvaluateConfig,
) -> list[CandidateSet]:
    """Return the candidate sets of `config.candidates`, from views and location_id (L,) of `views_of`.

    Raises a TableError if all labels of a set are of one class.
    """
    rank = np.concatenate([table["visibility_rank"].to_numpy(np.int64) for table in tables])
    sets = []
    for best in config.candidates:
        mask = rank < best if best else np.ones(len(rank), dtype=bool)
        check_labels(views.good[mask, 0], candidates_label(best), scenes[0].table)
        kept = np.unique(views.location[mask])
        sets.append(CandidateSet(candidates_label(best), mask, views.only(mask), location_id[kept]))
    return sets


def check_labels(labels: NDArray[np.bool_], name: str, path: Path) -> None:
    """Raise a TableError, which names the file, if the labels (B,) of a candidate set are all of one class."""
    if labels.all() or not labels.any():
        problem = f"all {len(labels)} candidates ({name}) have the same label"
        fix = "Label more viewpoints, or choose other thresholds or candidates."
        raise TableError(problem, path=path, value=bool(labels.any()), fix=fix)
