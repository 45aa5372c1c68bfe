"""What a view can be expected to find: landmarks weighted by the probability that the localizer finds them."""

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
from wheretolook.scorers.landmark_scorer import LandmarkScorer
from wheretolook.scorers.matchability.network import MatchabilityNetwork, expected_parts
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.training.training_range import QUANTITIES, camera_quantities, view_quantities
from wheretolook.utils.errors import ConfigError
from wheretolook_paper.fisher.metrics import METRICS, metric_of
from wheretolook_paper.scorers.pooled_features import image_cells

BINS = 30  # bins along each side of the image, of which those expected to hold a found landmark are counted

INLIERS = "inliers"
FILLED = "bins"


class Expectation:
    """What the views of a map can be expected to find, shared by all scorers that are made of it."""

    _of_maps: ClassVar[WeakKeyDictionary[LocalizationMap, dict[str, Expectation]]] = WeakKeyDictionary()

    def __init__(self, localization_map: LocalizationMap, matchability: TrainedNetwork[MatchabilityNetwork]) -> None:
        # not the map itself: a value that refers to its key would keep both alive
        self.matchability = matchability
        self.camera = localization_map.camera
        self._poses: Float = np.empty((0, 3, 4))
        self._sums: Float = np.empty((0, 17))
        self.quantities: Float = np.empty((0, len(QUANTITIES)))  # of the views that `sums` was asked for last

    @classmethod
    def of_map(cls, localization_map: LocalizationMap, weights: str | Path) -> Expectation:
        """What a map's views can be expected to find by a file of weights, made once for each map and file.

        Raises a WeightsError if the file cannot be used, or was trained for another field of view than the camera's.
        """
        known = cls._of_maps.setdefault(localization_map, {})
        if str(weights) not in known:
            device = localization_map.device
            trained = TrainedNetwork.load(weights, MatchabilityNetwork, "matchability", device=device)
            known[str(weights)] = cls(localization_map, trained)
        return known[str(weights)]

    def sums(self, describer: LandmarkDescriber, cam_from_world: Float) -> Float:
        """What views (B, 3, 4) can be expected to find, (B, 17). The describer gives the attributes the model takes.

        Landmarks expected to be found; their information on the pose, 15 numbers (see `wheretolook.geometry.pose_information`,
        in the camera's axes); bins expected to hold one that is found.
        """
        cam_from_world = check_poses(cam_from_world)
        if not np.array_equal(cam_from_world, self._poses):  # several methods ask for the same block of views
            sums = np.empty((len(cam_from_world), 17))
            quantities = np.empty((len(sums), len(QUANTITIES)))
            of_camera = camera_quantities(self.camera)
            for rows, described, n_in_view in describer.in_blocks(cam_from_world):
                quantities[rows] = view_quantities(described, n_in_view, of_camera)
                log_odds = self.log_odds(described.values)
                parts = expected_parts(described.values, log_odds, described.attributes)[:, :16].double()
                sums[rows, :16] = torch.segment_reduce(parts, "sum", lengths=described.counts, initial=0.0).cpu()
                sums[rows, 16] = self._filled(described, log_odds).cpu()
            self._poses = cam_from_world.copy()
            self._sums = sums
            self.quantities = quantities
        return self._sums

    def log_odds(self, values: Tensor) -> Tensor:
        """Calibrated log-odds (E,) of being found of landmarks (E, A)."""
        with torch.inference_mode():
            return self.matchability.calibrated(self.matchability.network(values))

    def _filled(self, described: ViewLandmarks, log_odds: Tensor) -> Tensor:
        """Bins expected to hold at least one landmark that is found, each found or not on its own, (B,)."""
        cells = described.views * BINS**2 + image_cells(described, self.camera, BINS)
        missed = torch.zeros(len(described) * BINS**2, dtype=torch.float64, device=cells.device)
        missed.index_add_(0, cells, torch.nn.functional.logsigmoid(-log_odds).double())
        return (1 - missed.exp()).view(len(described), -1).sum(1)


class ExpectedScorer(LandmarkScorer):
    """Landmarks in view, each by its learned chance of being found; or the bins of the image expected to hold one.

    The kind "inliers" is the share of the map's landmarks expected to be found; "bins" the share of the image's bins
    expected to hold one that is; a ConfigError of others. See `Expectation.of_map` for unfit weights.
    """

    def __init__(self, localization_map: LocalizationMap, weights: str | Path, kind: str) -> None:
        if kind not in (INLIERS, FILLED):
            raise ConfigError("unknown expectation", value=kind, fix=f"There are {INLIERS} and {FILLED}.")
        self._expectation = expectation = Expectation.of_map(localization_map, weights)
        trained = expectation.matchability
        super().__init__(localization_map, trained.network.attributes, trained.training_range, trained.camera)
        self.kind = kind
        self.name = f"expected-{kind}"
        self.local = kind == FILLED  # the share of the map's landmarks falls with every landmark that is added

    def score(self, cam_from_world: Float) -> Float:
        """(B,) in [0, 1]."""
        sums = self._expectation.sums(self.describer, cam_from_world)
        self._watch.check(self.name, [self._expectation.quantities])
        if self.kind == FILLED:
            return sums[:, 16] / BINS**2
        return sums[:, 0] / max(1, len(self.localization_map.landmarks))

    def expected_inliers(self, cam_from_world: Float) -> Float:
        """(B,), the sum of the chances of being found over the landmarks in view."""
        return self._expectation.sums(self.describer, cam_from_world)[:, 0]

    def log_odds_of_detection(self, values: Tensor) -> Tensor:
        """Return the calibrated log-odds (E,) that landmarks (E, A) are detected."""
        return self._expectation.log_odds(values)


class ExpectedFisherScorer(LandmarkScorer):
    """Expected Fisher information of the pose, each landmark in view weighted by its learned chance of being found.

    The metric is "mineig", "logdet" or "trace"; a ConfigError of others. See `Expectation.of_map` for unfit weights.
    """

    local = True

    def __init__(self, localization_map: LocalizationMap, weights: str | Path, metric: str) -> None:
        if metric not in METRICS:
            raise ConfigError("unknown metric of information", value=metric, fix=f"There are {', '.join(METRICS)}.")
        self._expectation = expectation = Expectation.of_map(localization_map, weights)
        trained = expectation.matchability
        super().__init__(localization_map, trained.network.attributes, trained.training_range, trained.camera)
        self.metric = metric
        self.name = f"fisher-{metric}-expected"

    def score(self, cam_from_world: Float) -> Float:
        """(B,), not bounded by 1."""
        numbers = self._expectation.sums(self.describer, cam_from_world)[:, 1:16]
        self._watch.check(self.name, [self._expectation.quantities])
        return metric_of(numbers, self.metric, device=self.localization_map.device)

    def log_odds_of_detection(self, values: Tensor) -> Tensor:
        """Return the calibrated log-odds (E,) that landmarks (E, A) are detected."""
        return self._expectation.log_odds(values)
