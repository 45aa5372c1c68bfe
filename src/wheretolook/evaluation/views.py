"""Labelled views of an evaluation, and the candidate sets of them to choose from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.viewpoint_table import by_first, has_first, is_good, poses
from wheretolook.evaluation.config import EvaluateConfig, candidates_label
from wheretolook.evaluation.ranking import CandidateViews, Ids, SceneViews, join_scenes
from wheretolook.geometry.poses import camera_centers
from wheretolook.utils.errors import TableError


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
    views: CandidateViews
    location_id: Ids


def views_of(
    scenes: Sequence[SceneFolder], tables: Sequence[pd.DataFrame], config: EvaluateConfig
) -> tuple[CandidateViews, Ids]:
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
    views: CandidateViews,
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
