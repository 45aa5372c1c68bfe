"""Scorer of scene-adapted weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from wheretolook.geometry.poses import Float, check_locations
from wheretolook.geometry.views import Views
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scorers.adapted.calibration import finite_log_odds
from wheretolook.scorers.adapted.network import AdaptedNetwork
from wheretolook.scorers.adapted.place import MIN_SHARE, share_of_place
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import BuildOptions
from wheretolook.scorers.set.score import SetScorer
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.errors import WeightsError

MIN_DISTANCE = 1e-12  # of probabilities from 0 and 1, so that their log-odds are finite


def adapted_scorer(localization_map: LocalizationMap, options: BuildOptions) -> Scorer:
    """Build the scorer of adapted weights; a WeightsError if the map is of another scene."""
    assert options.weights is not None
    trained = TrainedNetwork.load(options.weights, AdaptedNetwork, "adapted")
    share = share_of_place(trained.network.place.numpy(), localization_map.landmarks.points)
    if share < MIN_SHARE and not options.anywhere:
        fix = (
            "Adapt to this map, or use weights for any scene, such as the bundled ones. To use them anyway: --anywhere "
            "(select, check), --viewpoint_map.anywhere true, --plan.anywhere true, --evaluate.anywhere true, in Python "
            "anywhere=True."
        )
        problem = f"these weights are adapted to another scene: this map has {share:.0%} of its landmarks"
        raise WeightsError(problem, fix=fix)
    return AdaptedScorer(localization_map, trained)


class AdaptedScorer(Scorer):
    """The set network with log-odds calibrated by localized views of one scene."""

    name = "adapted"

    def __init__(self, localization_map: LocalizationMap, trained: TrainedNetwork[AdaptedNetwork]) -> None:
        super().__init__(localization_map)
        network = trained.network
        self.trained = trained
        of_base = network.network, trained.camera, network.base_scale, network.base_offset, trained.training_range
        known = replace(localization_map, photographs=False)  # the base is calibrated for this map already
        self.base = SetScorer(known, TrainedNetwork("set", *of_base))

    def score(self, cam_from_world: Float) -> Float:
        """Return probabilities (B,) in [0, 1]."""
        return self._adapted(self.base.score(cam_from_world))

    def score_directions(self, locations: Float, directions: Float) -> Float:
        """Return probabilities (L, D); see `SetScorer.score_directions`."""
        return self._adapted(self.base.score_directions(check_locations(locations), directions))

    def report(self, cam_from_world: Float) -> Views:
        """Return the base network's report with the adapted score."""
        report = self.base.report(cam_from_world)
        return replace(report, method=self.name, score=self._adapted(report.score))

    def in_range(self, cam_from_world: Float) -> NDArray[np.bool_]:
        """Return which poses (B, 3, 4) have views in the range of the training views, (B,)."""
        return self.base.in_range(cam_from_world)

    def _adapted(self, probability: Float) -> Float:
        return np.asarray(expit(self.trained.scale * log_odds_of(probability) + self.trained.offset))


def log_odds_of(probability: Float) -> Float:
    """Return finite log-odds of probabilities in [0, 1]."""
    return finite_log_odds(probability, MIN_DISTANCE)
