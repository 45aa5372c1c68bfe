"""Score held-out photographs by any methods, each on the map without its block; as views to adapt on and to evaluate."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.config import Accuracy
from wheretolook.dataset.layout import SceneFolder
from wheretolook.evaluation.scoring import HeldOutPhotographs, score_scale
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.holdout.holdout import HoldoutResult
from wheretolook.holdout.metrics import places_of
from wheretolook.holdout.photo_map import MAX_ERROR_M, PhotographedMap
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.colmap_model import compact_poses
from wheretolook.mapping.landmarks import load_colmap_landmarks
from wheretolook.mapping.map import Map
from wheretolook.scorers.adapted.calibration import LocalizedViews
from wheretolook.scorers.adapted.score import log_odds_of
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import make_scorer
from wheretolook.scorers.weights import load_scorer, resolve_weights
from wheretolook.training.weights import method_of_weights
from wheretolook.utils.errors import MapWarning, OutOfRangeWarning
from wheretolook.visibility.occlusion import CachedOcclusion, OcclusionModel

VISIBLE = "visible"  # the baseline; its score here is the number of landmarks in view


@dataclass(frozen=True)
class Scoring:
    """The method that is checked, and others that are compared.

    Attributes:
        method: name; "" for the method of the weights.
        weights: file or folder; None for the bundled ones.
        also: further methods, with bundled weights.
        anywhere: whether weights adapted to another scene are allowed.
        accuracy: up to which a photograph counts as localized; None for that of the weights.
    """

    method: str = ""
    weights: Path | None = None
    also: tuple[str, ...] = ()
    anywhere: bool = False
    accuracy: Accuracy | None = None

    def check(self) -> None:
        """Raise a WeightsError if weights of any of the methods are missing or unreadable."""
        for weights in (self.chosen, *(resolve_weights(name) for name in self.also)):
            if weights is not None:
                method_of_weights(weights)

    @property
    def chosen(self) -> Path | None:
        """The weights file of the checked method, on a map with SIFT features."""
        return resolve_weights(self.method, self.weights)

    def scorer(self, localization_map: LocalizationMap, anywhere: bool = False) -> Scorer:
        """Build the scorer of the checked method."""
        chosen = resolve_weights(self.method, self.weights, localization_map.landmarks.features)
        anywhere = anywhere or self.anywhere
        if self.method:
            scorer = make_scorer(self.method, localization_map, weights=chosen, anywhere=anywhere)
        else:
            scorer = load_scorer(localization_map, chosen, anywhere=anywhere)
        return scorer if self.accuracy is None else scorer.at_accuracy(self.accuracy)


def check_place(source: PhotographedMap, scoring: Scoring, device: str) -> None:
    """Raise a WeightsError if weights adapted to another scene would score, unless that is allowed.

    The whole map is tested, as the map without a block may lack most of the landmarks that identify the scene.
    """
    chosen = scoring.chosen
    if chosen is not None and method_of_weights(chosen) == "adapted" and not scoring.anywhere:
        with warnings.catch_warnings(action="ignore", category=MapWarning):
            landmarks = load_colmap_landmarks(source.path, reconstruction=source.model, progress=False)
        whole = Map(landmarks, has_photographs=source.photographs)
        scoring.scorer(LocalizationMap(whole, source.cameras[0], device=device))


def whole_map(source: PhotographedMap, occlusion: OcclusionModel, device: str) -> LocalizationMap:
    """Return the map with all photographs, for the camera of the first."""
    return LocalizationMap(source.map, source.cameras[0], occlusion, device)


def score_views(
    source: PhotographedMap, results: Sequence[HoldoutResult], scoring: Scoring, occlusion: OcclusionModel, device: str
) -> tuple[str, pd.DataFrame]:
    """Score the views of all blocks; returns the name of the checked method, and the views with further columns.

    They are score, expected_inliers and expected errors (NaN where the method has none), n_visible, in_range, `visible`
    (n_visible again), one for each further method, block and is_part. Scores that are shares of the map's landmarks
    are multiplied by their number, as blocks have maps of different sizes.
    """
    parts = []
    name = ""
    with tqdm(total=sum(len(one.views) for one in results), desc="check: score", unit="view") as bar:
        for one in results:
            columns: dict[str, NDArray[np.generic]] = {}
            for rows, remaining in maps_without(source, one, occlusion, device):
                poses = np.stack([pose for _, pose in _views(source, one.views.iloc[rows])])
                name, scores = _score(remaining, poses, scoring)
                for column, values in scores.items():
                    columns.setdefault(column, np.empty(len(one.views), values.dtype))[rows] = values
                bar.update(len(rows))
            parts.append(one.views.assign(**columns, block=one.block.number, is_part=one.block.is_part))
    return name, pd.concat(parts, ignore_index=True)


def maps_without(
    source: PhotographedMap, result: HoldoutResult, occlusion: OcclusionModel, device: str
) -> Iterator[tuple[NDArray[np.int64], LocalizationMap]]:
    """Yield, for each camera, the rows of a block's views, and the map without the block for that camera."""
    remaining = np.setdiff1d(np.arange(len(source.poses)), result.block.held_out)
    cached = occlusion if occlusion.name == "none" else CachedOcclusion(occlusion)
    cameras = [camera for camera, _ in _views(source, result.views)]
    poses = compact_poses(source.poses[remaining])
    whole = source.map if source.photographs else None
    part = Map(result.landmarks, poses, has_photographs=source.photographs, whole=whole)
    localization_map = LocalizationMap(part, cameras[0], cached, device)
    for camera in dict.fromkeys(cameras):
        rows = np.array([row for row, other in enumerate(cameras) if other == camera])
        yield rows, localization_map.of_camera(camera)


def _views(source: PhotographedMap, views: pd.DataFrame) -> list[tuple[Camera, Float]]:
    """Return camera and pose (3, 4) of each view."""
    return [source.view(row, crop) for row, crop in views[["row", "crop"]].to_numpy().tolist()]


def _score(
    localization_map: LocalizationMap, poses: Float, scoring: Scoring
) -> tuple[str, dict[str, NDArray[np.generic]]]:
    """Score poses (B, 3, 4) by all methods; returns the checked method's name, and columns (B,)."""
    with warnings.catch_warnings(action="ignore", category=OutOfRangeWarning):  # the column in_range reports them
        scorer = scoring.scorer(localization_map, anywhere=True)  # `check_place` has been called
        report = scorer.report(poses)
        unknown = np.full(len(poses), np.nan)
        columns: dict[str, NDArray[np.generic]] = {
            "score": report.score * score_scale(scorer.name, localization_map),
            "expected_inliers": report.expected_inliers,
            "expected_error_m": unknown if report.expected_error_m is None else report.expected_error_m,
            "expected_error_deg": unknown if report.expected_error_deg is None else report.expected_error_deg,
            "n_visible": np.asarray(report.n_visible, dtype=np.int64),
            "in_range": report.in_range,
            VISIBLE: np.asarray(report.n_visible, dtype=np.float64),
        }
        for name in scoring.also:
            if name not in (VISIBLE, scorer.name):
                weights = resolve_weights(name, features=localization_map.landmarks.features)
                other = make_scorer(name, localization_map, weights=weights)
                columns[name] = other.score(poses) * score_scale(name, localization_map)
    return scorer.name, columns


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
