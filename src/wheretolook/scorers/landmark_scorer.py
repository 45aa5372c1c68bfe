"""Base of the scorers that learned from single visible landmarks."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float, check_poses
from wheretolook.inputs.landmark_features import LandmarkDescriber, ViewLandmarks
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scorers.base import LandmarkProbabilities, Scorer
from wheretolook.scorers.matchability.network import bearing_precision
from wheretolook.training.training_range import RangeWatch, TrainingRange, camera_quantities, view_quantities
from wheretolook.visibility.frustum import LandmarkSets


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
        self._serves_camera = bool(self.training_range.contains(self._of_camera[None])[0])
        self._watch = RangeWatch(self.training_range.bounds_landmarks or not self._serves_camera)

    def in_range(self, cam_from_world: Float) -> NDArray[np.bool_]:
        """Return which poses (B, 3, 4) have views like the training views, (B,) bool."""
        cam_from_world = check_poses(cam_from_world)
        inside = np.full(len(cam_from_world), self._serves_camera)
        if self._serves_camera and self.training_range.bounds_landmarks:
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
