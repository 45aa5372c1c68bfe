"""Held-out photographs as views of an evaluation, each scored on the map that was built without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.viewpoint_table import is_good
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.ranking import SceneViews, join_scenes
from wheretolook.evaluation.scores import PHOTOGRAPHS
from wheretolook.evaluation.scoring import Weights, join_scores, score_batches, scorers_of
from wheretolook.evaluation.views import CandidateSet, check_labels
from wheretolook.geometry.poses import Float
from wheretolook.inputs.localization_map import LocalizationMap


@dataclass(frozen=True, eq=False)
class HeldOutPhotographs:
    """B photographs of a scene, block after block, and the maps without them.

    Attributes:
        scene: the scene.
        views: columns photograph (number, unique in a block), block, place (number of the location that views of a
            block share), status, error_m (scaled to metres where the map has none) and error_deg.
        poses: (B, 3, 4) cam_from_world.
        maps: rows of `views`, and the map that they are scored on.
    """

    scene: SceneFolder
    views: pd.DataFrame
    poses: Float
    maps: Sequence[tuple[NDArray[np.int64], LocalizationMap]]

    @property
    def occlusion(self) -> str:
        """Name of the occlusion model."""
        return self.maps[0][1].occlusion.name


def photographs_set(photographs: Sequence[HeldOutPhotographs], config: EvaluateConfig) -> CandidateSet:
    """Return the photographs of scenes as candidates; views of a block at the same place are one location.

    Locations with a single view count, although they leave no choice. Raises a TableError if all photographs have the
    same label.
    """
    views, location_id = join_scenes([_scene_views(one.views, config) for one in photographs])
    check_labels(views.good[:, 0], PHOTOGRAPHS, photographs[0].scene.map)
    return CandidateSet(PHOTOGRAPHS, np.ones(len(views.good), dtype=bool), views, location_id)


def _scene_views(views: pd.DataFrame, config: EvaluateConfig) -> SceneViews:
    ids, first, rows = np.unique(views["place"].to_numpy(np.int64), return_index=True, return_inverse=True)
    good = np.stack([is_good(views, *limits) for limits in config.thresholds], axis=-1)
    names = views["photograph"].to_numpy(np.int64)
    return SceneViews(rows.reshape(-1), names, good, ids, views["block"].to_numpy(np.int64)[first])


def score_photographs(
    photographs: Sequence[HeldOutPhotographs], config: EvaluateConfig, weights: Weights, progress: bool
) -> dict[str, Float]:
    """Score (B,) the photographs of scenes by each method; raises as `wheretolook.evaluation.scoring.score_scenes`."""
    parts = []
    n_views = sum(len(one.views) for one in photographs)
    with tqdm(total=n_views, desc="score photographs", unit="view", disable=not progress) as bar:
        for one in photographs:
            # the map with most landmarks decides whether weights adapted to another scene are rejected
            largest = max((remaining for _, remaining in one.maps), key=lambda remaining: len(remaining.landmarks))
            scorers_of(largest, config, weights)
            parts.append(score_batches(one.scene, one.poses, one.maps, config, weights, bar, held_out=True))
    return join_scores(parts)
