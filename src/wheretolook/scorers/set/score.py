"""Score views by the set of their landmarks: views one by one, or all directions at a location at once."""

from __future__ import annotations

import warnings
from bisect import bisect_left
from copy import copy, deepcopy
from dataclasses import replace
from math import exp, isnan, nan, sqrt
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wheretolook.dataset.config import Accuracy, checked_accuracy, threshold_key
from wheretolook.geometry.camera import Camera, ColmapCamera
from wheretolook.geometry.lattices import spread_rows
from wheretolook.geometry.poses import Float, check_poses
from wheretolook.geometry.views import Views
from wheretolook.inputs.landmark_features import LandmarkDescriber, ViewLandmarks
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.colmap_model import observation_matrix, select_points
from wheretolook.mapping.map import Map
from wheretolook.mapping.track_errors import log_error_ratio
from wheretolook.scorers.base import LandmarkProbabilities, Scorer
from wheretolook.scorers.set.accuracy import PhotographModel, model_of, probabilities, statistics_of
from wheretolook.scorers.set.directions import BatchedDirections
from wheretolook.scorers.set.network import SetNetwork, bearing_precision
from wheretolook.training.trained_network import (
    MapCalibration,
    RangeWatch,
    TrainedNetwork,
    TrainingRange,
    camera_quantities,
    view_quantities,
)
from wheretolook.utils.errors import MapWarning
from wheretolook.visibility.frustum import LandmarkSets
from wheretolook.visibility.occlusion import CachedOcclusion, StoredOcclusion


class LandmarkScorer(Scorer):
    """Scores a view by the named attributes of its visible landmarks, of which at most `max_landmarks` are described.

    Without a stored range of the training views, the field of view of their camera, if it was one, bounds the range.
    `score` warns once with an `OutOfRangeWarning`, see `RangeWatch`.
    """

    max_landmarks: int | None = None

    def __init__(
        self,
        localization_map: LocalizationMap,
        attributes: tuple[str, ...],
        training_range: TrainingRange | None,
        camera: Camera | None,
    ) -> None:
        super().__init__(localization_map)
        self.training_range = TrainingRange.of_camera(camera) if training_range is None else training_range
        self.describer = LandmarkDescriber(localization_map, attributes)
        self._of_camera = camera_quantities(localization_map.camera)
        self.serves_camera = bool(self.training_range.contains(self._of_camera[None])[0])
        self._watch = RangeWatch(self.training_range.bounds_landmarks or not self.serves_camera)

    def in_range(self, cam_from_world: Float) -> NDArray[np.bool_]:
        """Return which poses (B, 3, 4) have views like the training views, (B,) bool."""
        cam_from_world = check_poses(cam_from_world)
        inside = np.full(len(cam_from_world), self.serves_camera)
        if self.serves_camera and self.training_range.bounds_landmarks:
            for rows, described, n_visible in self.describer.in_blocks(cam_from_world, self.max_landmarks):
                inside[rows] = self._in_range(described, n_visible)
        return inside

    def log_odds_of_detection(self, values: Tensor) -> Tensor | None:
        """Return the log-odds (E,) that landmarks (E, A) are detected; None if the method does not predict them."""
        return None

    def landmark_probabilities(
        self, cam_from_world: Float, visible: LandmarkSets | None = None
    ) -> LandmarkProbabilities | None:
        """See `Scorer.landmark_probabilities`."""
        with torch.inference_mode():
            described = self.describer.describe(check_poses(cam_from_world), visible)
            log_odds = self.log_odds_of_detection(described.values)
            if log_odds is None:
                return None
            precision = bearing_precision(described.values, described.attributes)
        return LandmarkProbabilities(
            described.rows.cpu().numpy(), log_odds.sigmoid().double().cpu().numpy(), precision.double().cpu().numpy()
        )

    def _in_range(self, described: ViewLandmarks, n_visible: Tensor) -> NDArray[np.bool_]:
        """Return which of some views are in the training range, (B,)."""
        return self.training_range.contains(view_quantities(described, n_visible, self._of_camera))

    def _quantities(self, described: ViewLandmarks, n_visible: Tensor) -> list[Float]:
        """Return the quantities the range watch checks; empty once it has warned, or has nothing to warn of."""
        return [view_quantities(described, n_visible, self._of_camera)] if self._watch.watching else []


OFFSETS = np.linspace(-1, 2, 61).tolist()


def for_map(trained: TrainedNetwork[SetNetwork], localization_map: LocalizationMap) -> TrainedNetwork[SetNetwork]:
    """Return a network calibrated for a map of photographs; the same network for a map of renders.

    The log-odds of detection get `detection_offset`, and errors the map's `error_scale`.
    """
    if not localization_map.map.has_photographs:
        return trained
    network = deepcopy(trained.network)
    last = network.matchability.layers[-1]
    assert isinstance(last, torch.nn.Linear)
    whole = localization_map.map.whole or localization_map.map
    offset, offset_error = _known_offset(network, localization_map, whole)
    scale, scale_error = error_scale(whole)
    spread = PhotographModel.bundled().errors[0].deviation
    of_map = MapCalibration(scale, scale_error, spread, offset, offset_error)
    whole.computed.setdefault("calibration", of_map)
    with torch.no_grad():
        last.bias.add_(offset)
    return replace(trained, network=network, of_map=of_map)


def error_scale(whole: Map) -> tuple[float, float | None]:
    """Return the scale of the errors of a map's poses, and the standard error of its log, None if tracks show none.

    It is the map's keypoint noise in pixels, times a factor by its tracks. The noise is at least a tenth of a pixel, less
    than that of SIFT: maps made from exact points have none. Of the log of the factor, `log_error_ratio` over its mean of
    maps of photographs, 0.4 counts (docs/research/cameras.md).
    """
    if "error_scale" not in whole.computed:
        noise_px = whole.landmarks.keypoint_noise_px
        if noise_px is None:
            text = "no landmark has a reprojection error: keypoints count as precise to a pixel"
            warnings.warn(f"{whole.path or 'map'}: {text}", MapWarning, stacklevel=2)
        noise_px = max(0.1, noise_px or 1.0)
        known = None if whole.images is None else log_error_ratio(whole.images, whole.cameras, noise_px)
        ratio, error = known or (0.27, nan)
        whole.computed["error_scale"] = noise_px * exp(0.4 * (ratio - 0.27)), None if isnan(error) else 0.4 * error
    return whole.computed["error_scale"]


def _known_offset(network: SetNetwork, localization_map: LocalizationMap, whole: Map) -> tuple[float, float | None]:
    """Return `detection_offset`, estimated once for all cameras and parts of a map."""
    known = whole.computed
    occlusion = localization_map.occlusion
    if isinstance(occlusion, CachedOcclusion):
        occlusion = occlusion.model
    if isinstance(occlusion, StoredOcclusion):  # of all landmarks at some locations only
        return 0.0, None
    key = (occlusion, *(float(values.sum()) for values in network.parameters()))
    if key not in known:
        known[key] = detection_offset(network, localization_map)
    return known[key]


def detection_offset(network: SetNetwork, localization_map: LocalizationMap) -> tuple[float, float | None]:
    """Estimate the offset of a network's log-odds of detection on a map, and its standard error, from landmarks' tracks.

    Eight blocks of images that share landmarks are held out, an eighth of the images each, and two images of each are
    tested. With the offset, the network predicts as many detections of the remaining landmarks as there are
    observations of them in these images. 0 and None if the images are unknown, fewer than five, or observe hardly any of
    these landmarks. Measured in docs/research/cameras.md.
    """
    whole = localization_map.map.whole or localization_map.map
    images = whole.images
    if images is None or len(images.image_ids) < 5:
        return 0.0, None
    kept = np.zeros(len(images.points), dtype=bool)
    kept[:: max(1, -(-len(kept) // 20_000))] = True  # evenly spread
    images = select_points(images, kept)
    observes = observation_matrix(images)
    # of each block: observations, and landmarks in the lists below
    n_observed: list[float] = []
    lengths: list[int] = []
    log_odds: list[Tensor] = []
    weights: list[Tensor] = []
    seeing = np.flatnonzero(np.asarray(observes.sum(1)).reshape(-1))
    for first in seeing[spread_rows(len(seeing), 8)]:
        common = (observes @ observes[[first]].T).toarray().reshape(-1)
        block = np.argsort(-common, kind="stable")[: max(1, round(len(images.image_ids) / 8))]
        block = block[common[block] > 0]
        remaining = whole.without(images, block)
        if len(remaining) == 0:
            continue
        describer = LandmarkDescriber(replace(localization_map, map=Map(remaining)), network.attributes)
        tested = block[spread_rows(len(block), 2)]
        n_observed.append(float(observes[tested][:, np.isin(images.point_ids, remaining.ids)].sum()))
        lengths.append(0)
        for row in tested:
            camera = whole.cameras[int(images.image_cameras[row])]
            views = describer.of_camera(camera).in_blocks(images.image_poses[[row]], 512)
            for _, described, n_visible in views:
                with torch.inference_mode():
                    log_odds.append(network.matchability(described.values).double())
                weights.append((n_visible / max(1, len(log_odds[-1]))).expand(len(log_odds[-1])))
                lengths[-1] += len(log_odds[-1])
    if sum(n_observed) < 50:
        return 0.0, None
    each = torch.cat(weights)
    odds = torch.cat(log_odds)

    def surpluses(offset: float) -> Tensor:  # of each block
        predicted = (each * (odds + offset).sigmoid()).split(lengths)
        return torch.tensor([float(part.sum()) for part in predicted]) - torch.tensor(n_observed)

    row = bisect_left(OFFSETS, 0.0, key=lambda offset: float(surpluses(offset).sum()))
    offset = OFFSETS[min(row, len(OFFSETS) - 1)]
    p = (odds + offset).sigmoid()
    slope = float((each * p * (1 - p)).sum())  # of the sum of all surpluses
    n = len(lengths)
    if n == 1 or slope == 0:  # where all landmarks are occluded
        return offset, None
    return offset, surpluses(offset).std().item() * sqrt(n) / slope


MAX_LANDMARKS = 1024
"""Landmarks of a view that are described at most; of more, an even sample represents all. Against all, log-odds differ
by 0.05 where a view sees thousands."""


NARROW = {"reprojection_error": 1.0, "triangulation_angle": -1.0, "distance_spread": -1.0}
"""Signs of the deviations of these attributes where landmarks were mapped from nearly one place."""


class SetScorer(LandmarkScorer):
    """Network over the set of visible landmarks: their probabilities of detection and their information on the pose."""

    max_landmarks = MAX_LANDMARKS

    def __init__(self, localization_map: LocalizationMap, trained: TrainedNetwork[SetNetwork]) -> None:
        super().__init__(localization_map, trained.network.attributes, trained.training_range, trained.camera)
        self.name = trained.method
        trained.network.to(localization_map.device)
        self.trained = for_map(trained, localization_map)
        self.network = self.trained.network
        self.accuracy = trained.accuracy
        signs = [NARROW.get(name, 0.0) for name in self.network.attributes]
        self._signs = torch.tensor(signs, device=localization_map.device)
        self._batched: BatchedDirections | None = None

    def at_accuracy(self, accuracy: Accuracy) -> Self:
        """See `Scorer.at_accuracy`."""
        scorer = copy(self)
        scorer.accuracy = checked_accuracy(accuracy, self.localization_map.landmarks.mapping_distance_m)
        own = scorer.accuracy == self.trained.accuracy
        scorer.name = self.trained.method if own else f"{self.trained.method} {threshold_key(accuracy)}"
        scorer.training_range = self.trained.range_at(scorer.accuracy)
        scorer._batched = None
        return scorer

    def score(self, cam_from_world: Float) -> Float:
        """Return probabilities (B,) in [0, 1]."""
        cam_from_world = check_poses(cam_from_world)
        scores = np.empty(len(cam_from_world))
        quantities: list[Float] = []
        for rows, described, n_visible in self.describer.in_blocks(cam_from_world, MAX_LANDMARKS):
            quantities += self._quantities(described, n_visible)
            views = self.network.sums_of(described, n_visible)
            scores[rows] = probabilities(self.trained, self.accuracy, views)
        self._watch.check(self.name, self.training_range, quantities)
        return scores

    def report(self, cam_from_world: Float) -> Views:
        """See `Scorer.report`; does not warn of views out of range, which the report names."""
        cam_from_world = check_poses(cam_from_world)
        n = len(cam_from_world)
        score = np.empty(n)
        expected_inliers = np.zeros(n)
        errors = np.empty((n, 2))
        n_visible = np.zeros(n, dtype=np.int64)
        in_range = np.full(n, self.serves_camera)
        out_of_range = np.full(n, "", dtype=object)
        for rows, described, visible in self.describer.in_blocks(cam_from_world, MAX_LANDMARKS):
            views = self.network.sums_of(described, visible)
            score[rows] = probabilities(self.trained, self.accuracy, views)
            expected_inliers[rows] = views.sums[:, 0].cpu().numpy()
            errors[rows] = model_of(self.trained).expected_errors(statistics_of(self.trained, views))
            n_visible[rows] = visible.cpu().numpy()
            errors[rows][n_visible[rows] == 0] = np.nan  # the prior alone
            in_range[rows] &= self._in_range(described, visible)
            out_of_range[rows] = self.training_range.texts(view_quantities(described, visible, self._of_camera))
        out_of_range[~in_range & (out_of_range == "")] = "triangulation angles of the landmarks"
        return Views(
            cam_from_world,
            self.localization_map.camera,
            self.name,
            score=score,
            expected_inliers=expected_inliers,
            n_visible=n_visible,
            in_range=in_range,
            out_of_range=out_of_range,
            expected_error_m=errors[:, 0],
            expected_error_deg=errors[:, 1],
            of_map=self.trained.of_map,
        )

    def _in_range(self, described: ViewLandmarks, n_visible: Tensor) -> NDArray[np.bool_]:
        deviations = self.network.matchability.input(described.values) * self._signs
        means = torch.segment_reduce(deviations, "mean", lengths=described.counts)
        # at most 1.5 standard deviations count, so that one attribute alone decides nothing
        narrow = means.clamp(max=1.5).sum(1).cpu().numpy()
        # 2.9 is 1.25 times what 0.1 % of the views of 18 rendered scenes exceed. Views of maps by a camera that turns in
        # place exceed it. There, 4 to 17 times the expected inliers are found: in training, small triangulation angles
        # occur at landmarks that are hard to match, with narrow baselines at all of them. NaN without landmarks.
        return super()._in_range(described, n_visible) & ~(narrow > 2.9)

    def log_odds_of_detection(self, values: Tensor) -> Tensor:
        """Return the log-odds (E,) that landmarks (E, A) are detected, by the network's part for single landmarks."""
        log_odds: Tensor = self.network.matchability(values)
        return log_odds

    def score_and_count(self, locations: Float, directions: Float) -> tuple[Float, NDArray[Any] | None]:
        """See `Scorer.score_and_count`; where many landmarks are visible, scores are of another sample than `score`'s.

        Of a camera of COLMAP the number is only estimated.
        """
        if self._batched is None or not np.array_equal(self._batched.directions, directions):
            self._batched = BatchedDirections(
                self.localization_map, self.trained, directions, MAX_LANDMARKS, self.accuracy
            )
        scores, counts = self._batched.score(locations)
        return scores, None if isinstance(self.localization_map.camera, ColmapCamera) else counts
