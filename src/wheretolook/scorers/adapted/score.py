"""Weights adapted to a scene, and their scorer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import expit

from wheretolook.geometry.poses import Float, check_locations
from wheretolook.geometry.views import Views
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scorers.base import Scorer, finite_log_odds
from wheretolook.scorers.registry import BuildOptions
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.scorers.set.score import SetScorer
from wheretolook.training.trained_network import MapCalibration, StoredNetwork, TrainedNetwork, finite
from wheretolook.utils.errors import WeightsError


class AdaptedNetwork(StoredNetwork):
    """A set network and its calibration.

    `place` holds some of the map's landmarks, by which the scene is recognized, in the map's frame in metres.
    """

    place: torch.Tensor  # (P, 3) float64 m

    def __init__(
        self, network: SetNetwork, scale: float, offset: float, place: int, error_scale: float | None = None
    ) -> None:
        super().__init__()
        self.network = network
        self.base_scale = scale
        self.base_offset = offset
        self.error_scale = error_scale
        self.register_buffer("place", torch.zeros((place, 3), dtype=torch.float64))

    def description(self) -> dict[str, Any]:
        """See `StoredNetwork.description`."""
        base = {"network": self.network.description(), "scale": self.base_scale, "offset": self.base_offset}
        return {"base": base | {"error_scale": self.error_scale}, "place": len(self.place)}

    @classmethod
    def of_description(cls, stored: Mapping[str, Any]) -> Self:
        """See `StoredNetwork.of_description`."""
        if "kernel" in stored:
            raise ValueError(
                "a Gaussian process, which is no longer applied, corrects them: run `wheretolook adapt` again"
            )
        base = stored["base"]
        place = int(stored["place"])
        if not 0 <= place <= 1_000_000:  # more are no weights of this program
            raise ValueError(f"invalid number of landmarks {place}")
        network = SetNetwork.of_description(base["network"])
        error_scale = base.get("error_scale")
        if error_scale is not None and not finite(error_scale) > 0:
            raise ValueError(f"the scale of the errors is {error_scale:g}")
        return cls(network, finite(base["scale"]), finite(base["offset"]), place, error_scale)


MIN_SHARE = 0.5
"""A map is of the scene if this share of the stored landmarks has one of the map's within 5 cm. A map with other filters,
or reconstructed again in the same frame, still is."""


def share_of_place(place: Float, landmarks: Float) -> float:
    """Return the share of stored landmarks (P, 3) m that a map's landmarks (N, 3) m contain; 1 if none are stored."""
    if len(place) == 0:
        return 1.0
    return float((cKDTree(landmarks).query(place)[0] <= 0.05).mean()) if len(landmarks) else 0.0


def adapted_scorer(localization_map: LocalizationMap, options: BuildOptions) -> Scorer:
    """Build the scorer of adapted weights; a WeightsError if the map is of another scene."""
    assert options.weights is not None
    trained = TrainedNetwork.load(options.weights, AdaptedNetwork, "adapted")
    share = share_of_place(trained.network.place.numpy(), localization_map.landmarks.points)
    if share < MIN_SHARE and not options.anywhere:
        fix = (
            "Adapt to this map, or use weights for any scene, such as the bundled ones. To use them anyway: --anywhere, "
            "--evaluate.anywhere true, in Python anywhere=True."
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
        rendered = replace(localization_map.map, has_photographs=False)
        known = replace(localization_map, map=rendered)  # the base is calibrated for this map already
        self.base = SetScorer(
            known,
            TrainedNetwork(
                "set",
                network.network,
                trained.camera,
                network.base_scale,
                network.base_offset,
                trained.training_range,
                of_map=None if network.error_scale is None else MapCalibration(network.error_scale),
            ),
        )

    def score(self, cam_from_world: Float) -> Float:
        """Return probabilities (B,) in [0, 1]."""
        return self._adapted(self.base.score(cam_from_world))

    def score_and_count(self, locations: Float, directions: Float) -> tuple[Float, NDArray[Any] | None]:
        """See `SetScorer.score_and_count`."""
        scores, counts = self.base.score_and_count(check_locations(locations), directions)
        return self._adapted(scores), counts

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
    return finite_log_odds(probability, 1e-12)
