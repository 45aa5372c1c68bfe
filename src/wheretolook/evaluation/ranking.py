"""Choose the best-scored views of each location and count how many of them localize."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import gammaln

from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.viewpoint_table import has_first, is_good, poses, with_first_labels
from wheretolook.evaluation.config import EvaluateConfig, candidates_label
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.geometry.views import Views
from wheretolook.utils.errors import TableError

Ids = NDArray[np.int64]


def numbered(views: Views) -> Views:
    """Number the locations of views: `waypoint` counts from 0 by scene and `location_id`, without gaps."""
    key = views.scene * (views.location_id.max(initial=0) + 1) + views.location_id
    return replace(views, waypoint=np.unique(key, return_inverse=True)[1])


def first_of_locations(views: Views) -> Views:
    """Return one view of each location of `numbered` views, in their order, for what all views of a location share."""
    return views[np.unique(views.waypoint, return_index=True)[1]]


def n_locations(views: Views) -> int:
    """Return how many locations `numbered` views have."""
    return int(views.waypoint.max(initial=-1)) + 1


@dataclass(frozen=True, eq=False)
class TopN:
    """Counts of the N views chosen at each of L locations; expectations and probabilities for random choice."""

    chosen: Float  # (L,) views chosen: N, or all there are
    good: Float  # (L, T) how many of them are good within each threshold
    any_good: Float  # (L, T) 1 where at least one is

    def only(self, locations: NDArray[np.bool_]) -> TopN:
        """Return the counts of the locations where the mask (L,) is set."""
        return TopN(self.chosen[locations], self.good[locations], self.any_good[locations])


def rank_views(views: Views, scores: Float) -> Ids:
    """Rank views within their locations by scores (B,): (B,) from 0, the highest; ties by rising viewpoint_id."""
    order = np.lexsort((views.viewpoint_id, -scores, views.waypoint))
    location = views.waypoint[order]
    first = np.searchsorted(location, np.arange(n_locations(views)))
    ranks = np.empty(len(order), dtype=np.int64)
    ranks[order] = np.arange(len(order)) - first[location]
    return ranks


def choose_best(views: Views, ranks: Ids, n: int) -> TopN:
    """Choose the n views of every location that rank first (`rank_views`), or all where there are fewer."""
    return _top(views, _sum_by_location(views, views.good & (ranks < n)[:, None]), n)


def choose_oracle(views: Views, n: int) -> TopN:
    """Choose up to n good views of every location for each threshold: the oracle."""
    return _top(views, np.minimum(_sum_by_location(views, views.good), n), n)


def _top(views: Views, good: Float, n: int) -> TopN:
    return TopN(np.minimum(_n_views(views), n), good, (good > 0).astype(np.float64))


def choose_at_random(views: Views, n: int) -> TopN:
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


def _n_views(views: Views) -> Float:
    return np.bincount(views.waypoint, minlength=n_locations(views)).astype(np.float64)


def _sum_by_location(views: Views, flags: NDArray[np.bool_]) -> Float:
    columns = [np.bincount(views.waypoint, weights=column, minlength=n_locations(views)) for column in flags.T]
    return np.stack(columns, axis=-1)


def views_of(scenes: Sequence[SceneFolder], tables: Sequence[pd.DataFrame], config: EvaluateConfig) -> Views:
    """Return all labelled views of scenes in the order of their tables, `numbered`.

    `good` (V, T) is whether a view localizes within each of T thresholds; if all tables have labels by the first RANSAC
    result, too, (V, 2 T) by both. `block` is that of neighbouring locations, which are resampled together
    (`wheretolook.evaluation.statistics.ClusterBootstrap`). Raises a TableError if a table is empty, or a viewpoint has no
    label.
    """
    both = all(map(has_first, tables))
    parts = []
    for number, (scene, table) in enumerate(zip(scenes, tables, strict=True)):
        parts.append(_scene_views(number, scene, table, config, both))
    return numbered(Views.concatenate(parts))


def _scene_views(number: int, scene: SceneFolder, table: pd.DataFrame, config: EvaluateConfig, both: bool) -> Views:
    if table.empty:
        raise TableError("the table has no viewpoints", path=scene.table, fix="Run the sample stage again.")
    try:
        good = []
        for labelled in [table, with_first_labels(table)] if both else [table]:
            good += [is_good(labelled, max_m, max_deg) for max_m, max_deg in config.thresholds]
    except TableError as error:
        raise TableError(error.problem, path=scene.table, value=error.value, fix=error.fix) from None
    location_id = table["location_id"].to_numpy(np.int64)
    cam_from_world = poses(table)
    _, first, row = np.unique(location_id, return_index=True, return_inverse=True)
    block = np.arange(len(first))
    if config.block_m:
        floor = camera_centers(cam_from_world[first])[:, :2]
        squares = np.floor((floor - floor.min(0)) / config.block_m)
        block = np.unique(squares, axis=0, return_inverse=True)[1].reshape(-1)
    return Views(
        cam_from_world,
        scene=np.full(len(table), number),
        location_id=location_id,
        block=block[row.reshape(-1)],
        viewpoint_id=table["viewpoint_id"].to_numpy(np.int64),
        good=np.stack(good, axis=-1),
    )


def candidate_masks(
    views: Views, scenes: Sequence[SceneFolder], tables: Sequence[pd.DataFrame], config: EvaluateConfig
) -> dict[str, NDArray[np.bool_]]:
    """Return which views of `views_of` belong to each set of `config.candidates`, (V,), by its name.

    Raises a TableError if all labels of a set are of one class.
    """
    rank = np.concatenate([table["visibility_rank"].to_numpy(np.int64) for table in tables])
    masks = {}
    for best in config.candidates:
        mask = rank < best if best else np.ones(len(rank), dtype=bool)
        name = candidates_label(best)
        check_labels(views.good[mask, 0], name, scenes[0].table)
        masks[name] = mask
    return masks


def check_labels(labels: NDArray[np.bool_], name: str, path: Path) -> None:
    """Raise a TableError, which names the file, if the labels (B,) of a candidate set are all of one class."""
    if labels.all() or not labels.any():
        problem = f"all {len(labels)} candidates ({name}) have the same label"
        fix = "Label more viewpoints, or choose other thresholds or candidates."
        raise TableError(problem, path=path, value=bool(labels.any()), fix=fix)
