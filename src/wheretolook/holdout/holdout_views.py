"""Held-out photographs as views to adapt a scorer on, and as views of an evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from wheretolook.dataset.layout import SceneFolder
from wheretolook.evaluation.scoring import HeldOutPhotographs
from wheretolook.geometry.poses import camera_centers
from wheretolook.holdout.holdout import HoldoutResult
from wheretolook.holdout.metrics import places_of
from wheretolook.holdout.photo_map import MAX_ERROR_M, PhotographedMap
from wheretolook.holdout.scores import Scoring, maps_without, score_views
from wheretolook.scorers.adapted.calibration import LocalizedViews
from wheretolook.scorers.adapted.score import log_odds_of
from wheretolook.visibility.occlusion import OcclusionModel


def photographed_views(
    source: PhotographedMap,
    results: Sequence[HoldoutResult],
    weights: Path,
    occlusion: OcclusionModel,
    device: str = "cpu",
) -> LocalizedViews:
    """Score the photographs of all blocks, each on the map without its block; groups are blocks."""
    _, views = score_views(source, results, Scoring(weights=weights), occlusion, device)
    row = views["row"].to_numpy(np.int64)
    block = views["block"].to_numpy(np.int64)
    poses = source.poses[row]
    centers = camera_centers(poses)
    place = places_of(centers, block, source.place_radius)
    log_odds = log_odds_of(views["score"].to_numpy(np.float64))
    good = views["good"].to_numpy(bool)
    return LocalizedViews(log_odds, good, centers, poses[:, 2, :3], block, row, place)


def evaluated_photographs(
    scene: SceneFolder,
    source: PhotographedMap,
    results: Sequence[HoldoutResult],
    occlusion: OcclusionModel,
    device: str = "cpu",
) -> HeldOutPhotographs:
    """Return the photographs of all blocks of a scene's map as views of an evaluation.

    Where metres are unknown, errors are scaled to a map in which each limit is 5 cm.
    """
    views = pd.concat([one.views.assign(block=one.block.number) for one in results], ignore_index=True)
    poses = source.poses[views["row"].to_numpy()]
    maps = []
    begin = 0
    for one in results:
        maps += [(begin + rows, remaining) for rows, remaining in maps_without(source, one, occlusion, device)]
        begin += len(one.views)
    place = places_of(camera_centers(poses), views["block"].to_numpy(np.int64), source.place_radius)
    error_m = views["error_m"] * (MAX_ERROR_M / views["limit_m"])
    return HeldOutPhotographs(scene, views.assign(photograph=views["row"], place=place, error_m=error_m), poses, maps)
