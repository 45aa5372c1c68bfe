"""Scorer of scene-adapted weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from wheretolook.geometry.poses import Float, camera_centers, check_locations, check_poses
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scorers.adapted.kernel import Correction
from wheretolook.scorers.adapted.network import AdaptedNetwork
from wheretolook.scorers.adapted.place import LEAST_SAME, share_of_place
from wheretolook.scorers.base import Scorer, ViewReport
from wheretolook.scorers.method import ScorerOptions
from wheretolook.scorers.set.score import SetScorer
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.errors import WeightsError
from wheretolook.utils.probability import finite_log_odds

TINY = 1e-12  # distance of probabilities from 0 and 1, so that their log-odds are finite


def adapted_scorer(localization_map: LocalizationMap, options: ScorerOptions) -> Scorer:
    """Build the scorer of adapted weights; a WeightsError if the map is of another scene."""
    assert options.weights is not None
    trained = TrainedNetwork.load(options.weights, AdaptedNetwork, "adapted", device="cpu")
    return AdaptedScorer(localization_map, trained, anywhere=options.anywhere)


class AdaptedScorer(Scorer):
    """The set network with log-odds calibrated and corrected by localized views of one scene."""

    name = "adapted"

    def __init__(
        self, localization_map: LocalizationMap, trained: TrainedNetwork[AdaptedNetwork], anywhere: bool = False
    ) -> None:
        super().__init__(localization_map)
        network = trained.network
        self.trained = trained
        if not anywhere:
            _check_place(network.place.numpy(), localization_map)
        of_base = network.network, trained.camera, network.base_scale, network.base_offset, trained.training_range
        self.base = SetScorer(localization_map, TrainedNetwork("set", *of_base))
        centers = network.support_centers.numpy()
        axes = network.support_axes.numpy()
        kernel = network.length_m, network.sharpness
        self.correction = Correction(centers, axes, network.support_weights.numpy(), *kernel)

    def score(self, cam_from_world: Float) -> Float:
        """(B,) probabilities in [0, 1]."""
        poses = check_poses(cam_from_world)
        return self._corrected(self.base.score(poses), self.correction.at(camera_centers(poses), poses[:, 2, :3]))

    def score_around(self, locations: Float, directions: Float) -> Float:
        """Return probabilities (L, D); see `SetScorer.score_around`."""
        locations = check_locations(locations)
        return self._corrected(
            self.base.score_around(locations, directions), self.correction.grid(locations, directions)
        )

    def report(self, cam_from_world: Float) -> ViewReport:
        """Return the base network's report with the corrected score."""
        poses = check_poses(cam_from_world)
        report = self.base.report(poses)
        correction = self.correction.at(camera_centers(poses), poses[:, 2, :3])
        return replace(report, score=self._corrected(report.score, correction))

    def in_range(self, cam_from_world: Float) -> NDArray[np.bool_]:
        """Return which poses (B, 3, 4) have views in the range of the training views, (B,)."""
        return self.base.in_range(cam_from_world)

    def expected_inliers(self, cam_from_world: Float) -> Float:
        """Return how many landmarks poses (B, 3, 4) are expected to detect, (B,)."""
        return self.base.expected_inliers(cam_from_world)

    def _corrected(self, probability: Float, correction: Float) -> Float:
        return np.asarray(expit(self.trained.scale * log_odds_of(probability) + self.trained.offset + correction))


def log_odds_of(probability: Float) -> Float:
    """Return finite log-odds of probabilities in [0, 1]."""
    return finite_log_odds(probability, TINY)


def _check_place(place: Float, localization_map: LocalizationMap) -> None:
    same = share_of_place(place, localization_map.landmarks.points)
    if same < LEAST_SAME:
        fix = (
            "Adapt to this map, or use weights for any scene, such as the bundled ones. To use them anyway: --anywhere "
            "(select, check), --viewpoint_map.anywhere true, --plan.anywhere true, --evaluate.anywhere true, in Python "
            "anywhere=True."
        )
        problem = f"these weights are adapted to another scene, of whose landmarks this map has {same:.0%}"
        raise WeightsError(problem, fix=fix)
