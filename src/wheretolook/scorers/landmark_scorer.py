"""Scorers that have learnt from landmarks in view, one by one, and know what views they have learnt from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float, check_poses
from wheretolook.inputs.landmark_features import LandmarkDescriber, ViewLandmarks
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.range_watch import RangeWatch
from wheretolook.training.training_range import TrainingRange, camera_quantities, view_quantities


class LandmarkScorer(Scorer):
    """Scores a view by the named attributes of the landmarks it sees, of which at most `most` are looked at.

    Where the file of weights does not say what the training views were like, the range is that of their camera's field
    of view, if they had but one camera. `score` warns once with an `OutOfRangeWarning`, see `RangeWatch`.
    """

    most: int | None = None

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
        watching = self.training_range.asks_for_landmarks or not self._serves_camera
        self._watch = RangeWatch(self.training_range, watching)

    def in_range(self, cam_from_world: Float) -> NDArray[np.bool_]:
        """Which poses (B, 3, 4) see what is like the views learnt from, (B,) bool."""
        cam_from_world = check_poses(cam_from_world)
        inside = np.full(len(cam_from_world), self._serves_camera)
        if self._serves_camera and self.training_range.asks_for_landmarks:
            for rows, described, n_in_view in self.describer.in_blocks(cam_from_world, self.most):
                inside[rows] = self.training_range.contains(view_quantities(described, n_in_view, self._of_camera))
        return inside

    def _look(self, described: ViewLandmarks, n_in_view: Tensor) -> list[Float]:
        """What the watch wants to know of described views: nothing, if it has warned or has nothing to warn of."""
        return [view_quantities(described, n_in_view, self._of_camera)] if self._watch.watching else []
