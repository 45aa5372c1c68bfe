"""Scorer of a network over the set of visible landmarks."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from wheretolook.geometry.poses import Float, check_poses
from wheretolook.inputs.landmark_features import ViewLandmarks
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scorers.base import ViewReport
from wheretolook.scorers.landmark_scorer import LandmarkScorer
from wheretolook.scorers.set.batched_directions import BatchedDirections
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.training.trained_network import TrainedNetwork

MAX_LANDMARKS = 1024
"""Landmarks of a view that are described at most; of more, an even sample represents all. Against all, log-odds differ
by 0.05 where a view sees thousands."""


class SetScorer(LandmarkScorer):
    """Network over the set of visible landmarks: their probabilities of detection and their information on the pose."""

    local = True
    max_landmarks = MAX_LANDMARKS

    def __init__(self, localization_map: LocalizationMap, trained: TrainedNetwork[SetNetwork]) -> None:
        super().__init__(localization_map, trained.network.attributes, trained.training_range, trained.camera)
        self.name = trained.method
        self.trained = trained
        self.network = trained.network.to(localization_map.device)
        self._batched: BatchedDirections | None = None

    def score(self, cam_from_world: Float) -> Float:
        """Return probabilities (B,) in [0, 1]."""
        cam_from_world = check_poses(cam_from_world)
        scores = np.empty(len(cam_from_world))
        quantities: list[Float] = []
        for rows, described, n_visible in self.describer.in_blocks(cam_from_world, MAX_LANDMARKS):
            quantities += self._quantities(described, n_visible)
            scores[rows] = self._probabilities(cam_from_world[rows], described, n_visible)
        self._watch.check(self.name, quantities)
        return scores

    def report(self, cam_from_world: Float) -> ViewReport:
        """See `Scorer.report`; does not warn of views out of range, which the report names."""
        cam_from_world = check_poses(cam_from_world)
        n = len(cam_from_world)
        report = ViewReport(np.empty(n), np.zeros(n), np.zeros(n, dtype=np.int64), np.full(n, self._serves_camera))
        for rows, described, n_visible in self.describer.in_blocks(cam_from_world, MAX_LANDMARKS):
            report.score[rows] = self._probabilities(cam_from_world[rows], described, n_visible)
            report.n_visible[rows] = n_visible.cpu().numpy()
            report.in_range[rows] &= self._in_range(described, n_visible)
            with torch.inference_mode():
                p_detect = self.network.matchability(described.values).sigmoid().double()
                sums = torch.segment_reduce(p_detect, "sum", lengths=described.counts, initial=0.0)
                detected = sums * n_visible / described.counts.clamp(min=1)
            report.expected_inliers[rows] = detected.cpu().numpy()
        return report

    def log_odds_of_detection(self, values: Tensor) -> Tensor:
        """Return the log-odds (E,) that landmarks (E, A) are detected, by the network's part for single landmarks."""
        log_odds: Tensor = self.network.matchability(values)
        return log_odds

    def _probabilities(self, cam_from_world: Float, described: ViewLandmarks, n_visible: Tensor) -> Float:
        height = torch.from_numpy(cam_from_world[:, 2, 2]).to(described.values)
        with torch.inference_mode():
            logits = self.network.score(described, n_visible, height).double()
            return np.asarray(self.trained.calibrated(logits).sigmoid().cpu().numpy())

    def score_directions(self, locations: Float, directions: Float) -> Float:
        """Return probabilities (L, D); where many landmarks are visible, from a smaller sample than `score`."""
        if not BatchedDirections.serves(self.network):
            return super().score_directions(locations, directions)
        if self._batched is None or not np.array_equal(self._batched.directions, directions):
            self._batched = BatchedDirections(self.localization_map, self.trained, directions, MAX_LANDMARKS // 2)
        return self._batched.score(locations)
