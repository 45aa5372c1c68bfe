"""Scorer of a network over the set of visible landmarks."""

from __future__ import annotations

from copy import copy
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wheretolook.dataset.thresholds import Accuracy, checked_accuracy, threshold_key
from wheretolook.geometry.poses import Float, check_poses
from wheretolook.inputs.landmark_features import ViewLandmarks
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scorers.base import ViewReport
from wheretolook.scorers.landmark_scorer import LandmarkScorer
from wheretolook.scorers.set.accuracy import AccuracyModel, probabilities, statistics_of
from wheretolook.scorers.set.batched_directions import BatchedDirections
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.scorers.set.own_images import for_map
from wheretolook.training.trained_network import TrainedNetwork

MAX_LANDMARKS = 1024
"""Landmarks of a view that are described at most; of more, an even sample represents all. Against all, log-odds differ
by 0.05 where a view sees thousands."""


NARROW = {"reprojection_error": 1.0, "triangulation_angle": -1.0, "distance_spread": -1.0}
"""Signs of the deviations of these attributes where landmarks were mapped from nearly one place."""
MAX_DEVIATION = 1.5  # that counts, in standard deviations, so that one attribute alone decides nothing
MAX_NARROW = 2.9
"""Sum of the deviations of a view's mean attributes: 1.25 times what 0.1 % of the views of 18 rendered scenes exceed.
Views of maps by a camera that turns in place exceed it. There, 4 to 17 times the expected inliers are found: in
training, small triangulation angles occur at landmarks that are hard to match, with narrow baselines at all of them."""


class SetScorer(LandmarkScorer):
    """Network over the set of visible landmarks: their probabilities of detection and their information on the pose."""

    local = True
    max_landmarks = MAX_LANDMARKS

    def __init__(self, localization_map: LocalizationMap, trained: TrainedNetwork[SetNetwork]) -> None:
        super().__init__(localization_map, trained.network.attributes, trained.training_range, trained.camera)
        self.name = trained.method
        trained.network.to(localization_map.device)
        self.trained = for_map(trained, localization_map)
        self.network = self.trained.network
        if self.trained is not trained:
            self.local = False  # calibrated by images all over the map
        self.accuracy = trained.accuracy
        signs = [NARROW.get(name, 0.0) for name in self.network.attributes]
        self._signs = torch.tensor(signs, device=localization_map.device)
        self._batched: BatchedDirections | None = None

    def at_accuracy(self, accuracy: Accuracy) -> Self:
        """See `Scorer.at_accuracy`."""
        scorer = copy(self)
        scorer.accuracy = checked_accuracy(accuracy)
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
            scores[rows] = probabilities(
                self.trained, self.accuracy, *self._sums(cam_from_world[rows], described, n_visible)
            )
        self._watch.check(self.name, self.training_range, quantities)
        return scores

    def report(self, cam_from_world: Float) -> ViewReport:
        """See `Scorer.report`; does not warn of views out of range, which the report names."""
        cam_from_world = check_poses(cam_from_world)
        n = len(cam_from_world)
        in_range = np.full(n, self._serves_camera)
        report = ViewReport(np.empty(n), np.zeros(n), np.zeros(n, dtype=np.int64), in_range, np.empty((n, 2)))
        assert report.expected_errors is not None
        for rows, described, n_visible in self.describer.in_blocks(cam_from_world, MAX_LANDMARKS):
            sums = self._sums(cam_from_world[rows], described, n_visible)
            report.score[rows] = probabilities(self.trained, self.accuracy, *sums)
            report.expected_inliers[rows] = sums[0][:, 0].cpu().numpy()
            report.expected_errors[rows] = AccuracyModel.bundled().expected_errors(statistics_of(self.network, *sums))
            report.n_visible[rows] = n_visible.cpu().numpy()
            report.in_range[rows] &= self._in_range(described, n_visible)
        return report

    def _in_range(self, described: ViewLandmarks, n_visible: Tensor) -> NDArray[np.bool_]:
        deviations = self.network.matchability.input(described.values) * self._signs
        means = torch.segment_reduce(deviations, "mean", lengths=described.counts)
        narrow = means.clamp(max=MAX_DEVIATION).sum(1).cpu().numpy()
        return super()._in_range(described, n_visible) & ~(narrow > MAX_NARROW)  # NaN without landmarks

    def log_odds_of_detection(self, values: Tensor) -> Tensor:
        """Return the log-odds (E,) that landmarks (E, A) are detected, by the network's part for single landmarks."""
        log_odds: Tensor = self.network.matchability(values)
        return log_odds

    def _sums(self, cam_from_world: Float, described: ViewLandmarks, n_visible: Tensor) -> tuple[Tensor, ...]:
        """Return the arguments of `SetNetwork.logits` for described views."""
        height = torch.from_numpy(cam_from_world[:, 2, 2]).to(described.values)
        with torch.inference_mode():
            sums, cells = self.network.sums_of(described, n_visible)
        return sums, n_visible, height, cells

    def score_directions(self, locations: Float, directions: Float) -> Float:
        """Return probabilities (L, D); where many landmarks are visible, from a smaller sample than `score`."""
        if not BatchedDirections.serves(self.network):
            return super().score_directions(locations, directions)
        if self._batched is None or not np.array_equal(self._batched.directions, directions):
            self._batched = BatchedDirections(
                self.localization_map, self.trained, directions, MAX_LANDMARKS // 2, self.accuracy
            )
        return self._batched.score(locations)
