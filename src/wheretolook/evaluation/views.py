"""The labelled views of an evaluation, and the sets of them to choose from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.viewpoint_table import is_good, poses
from wheretolook.evaluation.config import EvaluateConfig, candidates_label
from wheretolook.evaluation.ranking import TestViews
from wheretolook.geometry.poses import camera_centers
from wheretolook.utils.errors import TableError


@dataclass(frozen=True, eq=False)
class CandidateSet:
    """Views to choose from."""

    name: str  # as in the column `candidates`: "all", or such as "best 100"
    mask: NDArray[np.bool_]  # (B,) which of all labelled views they are
    views: TestViews  # the views
    location_id: NDArray[np.int64]  # (L,) of their locations, unique within a scene


def views_of(
    scenes: Sequence[SceneFolder], tables: Sequence[pd.DataFrame], config: EvaluateConfig
) -> tuple[TestViews, NDArray[np.int64]]:
    """All labelled views of scenes in the order of their tables, and the location_id (L,) of each of their locations.

    Raises a TableError if a table is empty, or a viewpoint has no label.
    """
    location, location_scene, location_id, location_block = (list[NDArray[np.int64]]() for _ in range(4))
    good: list[NDArray[np.bool_]] = []
    for number, (scene, table) in enumerate(zip(scenes, tables, strict=True)):
        if table.empty:
            raise TableError("the table has no viewpoints", path=scene.table, fix="Run the sample stage again.")
        try:
            good.append(np.stack([is_good(table, *limits) for limits in config.thresholds], axis=-1))
        except TableError as error:
            raise TableError(error.problem, path=scene.table, value=error.value, fix=error.fix) from None
        ids, first, rows = np.unique(table["location_id"].to_numpy(np.int64), return_index=True, return_inverse=True)
        if config.block_m:
            floor = camera_centers(poses(table)[first])[:, :2]
            squares = np.floor((floor - floor.min(0)) / config.block_m)
            location_block.append(np.unique(squares, axis=0, return_inverse=True)[1].reshape(-1))
        else:
            location_block.append(np.arange(len(ids)))
        location.append(rows + sum(map(len, location_id)))
        location_id.append(ids)
        location_scene.append(np.full(len(ids), number))
    viewpoint_id = np.concatenate([table["viewpoint_id"].to_numpy(np.int64) for table in tables])
    scene_of = np.concatenate(location_scene)
    block_of = np.concatenate(location_block)
    views = TestViews(np.concatenate(location), viewpoint_id, np.concatenate(good), scene_of, block_of)
    return views, np.concatenate(location_id)


def candidate_sets(
    views: TestViews,
    location_id: NDArray[np.int64],
    scenes: Sequence[SceneFolder],
    tables: Sequence[pd.DataFrame],
    config: EvaluateConfig,
) -> list[CandidateSet]:
    """The sets of views to choose from that `config.candidates` names, of views and location_id (L,) by `views_of`.

    Raises a TableError if all labels of a set are of one class.
    """
    rank = np.concatenate([table["visibility_rank"].to_numpy(np.int64) for table in tables])
    found = []
    for best in config.candidates:
        mask = rank < best if best else np.ones(len(rank), dtype=bool)
        labels = views.good[mask, 0]
        if len(np.unique(labels)) < 2:
            metres, degrees = config.thresholds[0]
            which = f" among the {candidates_label(best)} candidates of each location" if best else ""
            counted = f"of {len(labels)} viewpoints all or none are within {metres:g} m and {degrees:g} degrees"
            problem = f"labels of one class only{which}: {counted}"
            value = bool(labels.any())
            fix = "Label more viewpoints, or give other evaluate.thresholds or evaluate.candidates."
            raise TableError(problem, path=scenes[0].table, value=value, fix=fix)
        kept = np.unique(views.location[mask])
        found.append(CandidateSet(candidates_label(best), mask, views.only(mask), location_id[kept]))
    return found
