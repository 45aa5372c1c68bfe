"""Photographs that were left out of their maps as views of an evaluation, each scored on the map without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.viewpoint_table import LOCALIZED
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.ranking import TestViews
from wheretolook.evaluation.score_table import PHOTOGRAPHS
from wheretolook.evaluation.scores import reference_method
from wheretolook.evaluation.scoring import Weights, scorers_of
from wheretolook.evaluation.views import CandidateSet
from wheretolook.geometry.poses import Float
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.utils.errors import TableError

_OF_THE_MAP = ("expected-inliers", "visible")  # methods that give a share of the map's landmarks


@dataclass(frozen=True, eq=False)
class LeftOutPhotographs:
    """B photographs of a scene, of one block after the other, and the maps without them.

    `views` has columns photograph (its number, unique in a block), block, place (number of the place that the view
    shares with others of its block), status, error_m (brought to metres where the map has none) and error_deg.
    """

    scene: SceneFolder
    views: pd.DataFrame
    poses: Float  # (B, 3, 4) cam_from_world
    maps: Sequence[tuple[NDArray[np.int64], LocalizationMap]]  # rows of views, and the map that they are scored on

    @property
    def occlusion(self) -> str:
        """Name of what hides landmarks."""
        return self.maps[0][1].occlusion.name


def photographs_set(photographs: Sequence[LeftOutPhotographs], config: EvaluateConfig) -> CandidateSet:
    """The photographs of scenes, by their numbers in this order, as views to choose from: at each place those of a
    block that share it. A place with one view has nothing to choose, but counts.

    Raises a TableError if all localize, or none.
    """
    location, location_scene, location_id, location_block = (list[NDArray[np.int64]]() for _ in range(4))
    good: list[NDArray[np.bool_]] = []
    for number, one in enumerate(photographs):
        views = one.views
        ids, first, rows = np.unique(views["place"].to_numpy(np.int64), return_index=True, return_inverse=True)
        location.append(rows.reshape(-1) + sum(map(len, location_id)))
        location_id.append(ids)
        location_scene.append(np.full(len(ids), number))
        location_block.append(views["block"].to_numpy(np.int64)[first])
        has_pose = views["status"].to_numpy() == LOCALIZED
        error_m = views["error_m"].to_numpy()
        error_deg = views["error_deg"].to_numpy()
        within = [has_pose & (error_m < metres) & (error_deg < degrees) for metres, degrees in config.thresholds]
        good.append(np.stack(within, axis=-1))
    names = np.concatenate([one.views["photograph"].to_numpy(np.int64) for one in photographs])
    labels = np.concatenate(good)
    if len(np.unique(labels[:, 0])) < 2:
        problem = "of the left-out photographs all localize, or none"
        fix = "Evaluate without evaluate.photographs."
        raise TableError(problem, path=photographs[0].scene.map, value=bool(labels[:, 0].any()), fix=fix)
    scene_of = np.concatenate(location_scene)
    block_of = np.concatenate(location_block)
    found = TestViews(np.concatenate(location), names, labels, scene_of, block_of)
    return CandidateSet(PHOTOGRAPHS, np.ones(len(labels), dtype=bool), found, np.concatenate(location_id))


def score_photographs(
    photographs: Sequence[LeftOutPhotographs], config: EvaluateConfig, weights: Weights, progress: bool
) -> dict[str, Float]:
    """Scores (B,) by method of the photographs of scenes; raises what `wheretolook.evaluation.scoring` does."""
    parts: dict[str, list[Float]] = {}
    with tqdm(
        total=sum(len(one.views) for one in photographs), desc="score photographs", unit="view", disable=not progress
    ) as bar:
        for one in photographs:
            # weights that are adapted to another place are refused by the map that has most of this one's landmarks
            scorers_of(
                max((around for _, around in one.maps), key=lambda around: len(around.landmarks)), config, weights
            )
            of_scene: dict[str, Float] = {}
            for rows, around in one.maps:
                scorers = scorers_of(around, config, weights, anywhere=True)
                reference_method(scorers, config.reference)
                poses = one.poses[rows]
                binned = around.bin_views(poses)
                for method, scorer in scorers.items():
                    values = scorer.score_binned(poses, binned) * number_of(scorer.name, around)
                    of_scene.setdefault(method, np.empty(len(one.views)))[rows] = values
                bar.update(len(rows))
            for method, values in of_scene.items():
                parts.setdefault(method, []).append(values)
    return {method: np.concatenate(values) for method, values in parts.items()}


def number_of(method: str, around: LocalizationMap) -> int:
    """What a method's scores are to be multiplied with, so that those of maps of different sizes can be compared."""
    return len(around.landmarks) if method in _OF_THE_MAP else 1
