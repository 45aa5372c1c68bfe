"""Expected detections of a view: landmarks weighted by the probability that the localizer detects them."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from wheretolook.geometry.poses import Float, check_poses
from wheretolook.inputs.landmark_features import LandmarkDescriber, ViewLandmarks
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scorers.set.network import MatchabilityNetwork, expected_parts
from wheretolook.scorers.set.score import LandmarkScorer
from wheretolook.training.trained_network import QUANTITIES, TrainedNetwork, camera_quantities, view_quantities
from wheretolook_paper.fisher.metrics import METRICS, metric_of
from wheretolook_paper.scorers.pooled_features import image_cells

BINS = 30  # bins along each side of the image


class Expectation:
    """Sums over the visible landmarks of a map's views, weighted by detection probability; shared by all scorers."""

    _of_maps: ClassVar[WeakKeyDictionary[LocalizationMap, dict[str, Expectation]]] = WeakKeyDictionary()

    def __init__(self, localization_map: LocalizationMap, matchability: TrainedNetwork[MatchabilityNetwork]) -> None:
        # not the map itself: a value that refers to its key would keep both alive
        self.matchability = matchability
        self.camera = localization_map.camera
        self._poses: Float = np.empty((0, 3, 4))
        self._sums: Float = np.empty((0, 17))
        self.quantities: Float = np.empty((0, len(QUANTITIES)))  # of the views of the last call of `sums`

    @classmethod
    def of_map(cls, localization_map: LocalizationMap, weights: str | Path) -> Expectation:
        """Return the expectation of a map by a file of weights, made once for each map and file.

        Raises a WeightsError if the file cannot be used, or was trained for another field of view than the camera's.
        """
        known = cls._of_maps.setdefault(localization_map, {})
        if str(weights) not in known:
            device = localization_map.device
            trained = TrainedNetwork.load(weights, MatchabilityNetwork, "matchability", device=device)
            known[str(weights)] = cls(localization_map, trained)
        return known[str(weights)]

    def sums(self, describer: LandmarkDescriber, cam_from_world: Float) -> Float:
        """Return the expected sums (B, 17) of views (B, 3, 4), whose landmarks the describer describes.

        Detected landmarks; their information on the pose, 15 numbers as in `wheretolook.geometry.pose_information`, in
        the camera's axes; image bins with a detected landmark.
        """
        cam_from_world = check_poses(cam_from_world)
        if not np.array_equal(cam_from_world, self._poses):  # several methods score the same block of views
            sums = np.empty((len(cam_from_world), 17))
            quantities = np.empty((len(sums), len(QUANTITIES)))
            of_camera = camera_quantities(self.camera)
            for rows, described, n_in_view in describer.in_blocks(cam_from_world):
                quantities[rows] = view_quantities(described, n_in_view, of_camera)
                log_odds = self.log_odds(described.values)
                parts = expected_parts(described.values, log_odds, described.attributes).double()
                sums[rows, :16] = torch.segment_reduce(
                    parts[:, :16], "sum", lengths=described.counts, initial=0.0
                ).cpu()
                sums[rows, 16] = self._filled_bins(described, log_odds).cpu()
            self._poses = cam_from_world.copy()
            self._sums = sums
            self.quantities = quantities
        return self._sums

    def log_odds(self, values: Tensor) -> Tensor:
        """Return the calibrated log-odds (E,) that landmarks (E, A) are detected."""
        with torch.inference_mode():
            return self.matchability.calibrated(self.matchability.network(values))

    def _filled_bins(self, described: ViewLandmarks, log_odds: Tensor) -> Tensor:
        """Return the expected number of bins with a detected landmark (B,), detections being independent."""
        cells = described.views * BINS**2 + image_cells(described, self.camera, BINS)
        log_missed = torch.zeros(len(described) * BINS**2, dtype=torch.float64, device=cells.device)
        log_missed.index_add_(0, cells, torch.nn.functional.logsigmoid(-log_odds).double())
        return (1 - log_missed.exp()).view(len(described), -1).sum(1)


class ExpectedScorer(LandmarkScorer):
    """Scores a view by an expected sum: "inliers", "bins", or a metric of Fisher information ("mineig", ...).

    "inliers" is the share of the map's landmarks that are expected to be detected, "bins" the share of image bins
    expected to have a detected landmark. Raises as `Expectation.of_map`.
    """

    def __init__(self, localization_map: LocalizationMap, weights: str | Path, kind: str) -> None:
        self._expectation = Expectation.of_map(localization_map, weights)
        trained = self._expectation.matchability
        super().__init__(localization_map, trained.network.attributes, trained.training_range, trained.camera)
        self.kind = kind
        self.name = f"fisher-{kind}-expected" if kind in METRICS else f"expected-{kind}"

    def score(self, cam_from_world: Float) -> Float:
        """Return (B,) in [0, 1]; metrics of information are not bounded by 1."""
        sums = self._expectation.sums(self.describer, cam_from_world)
        self._watch.check(self.name, self.training_range, [self._expectation.quantities])
        if self.kind == "bins":
            return sums[:, 16] / BINS**2
        if self.kind == "inliers":
            return sums[:, 0] / max(1, len(self.localization_map.landmarks))
        return metric_of(sums[:, 1:16], self.kind, self.localization_map.device)

    def expected_inliers(self, cam_from_world: Float) -> Float:
        """Return (B,), the sum of the detection probabilities of the visible landmarks."""
        return self._expectation.sums(self.describer, cam_from_world)[:, 0]

    def log_odds_of_detection(self, values: Tensor) -> Tensor:
        """Return the calibrated log-odds (E,) that landmarks (E, A) are detected."""
        return self._expectation.log_odds(values)
