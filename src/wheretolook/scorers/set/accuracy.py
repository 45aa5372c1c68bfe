"""Predicts the probability that a view localizes within any accuracy, and the error of its pose.

P(error within a) = P(right place) F(a), with F(a) = P(error within a | right place). A logistic regression predicts the
first factor from the network's own probability and the expected variance of the orientation. In the second, the logs of
both errors are normal: their means follow from the expected covariance of the pose and from other statistics that the
network computes anyway. The errors of position and orientation correlate at 0.92, so F is the smaller of their two
probabilities.

The network predicts the probability p at one accuracy b, that of its labels. The family

    P(a) = p F(a) / F(b)                               if F(a) <= F(b)
    P(a) = p + (q - p) (F(a) - F(b)) / (1 - F(b))      otherwise, with q = max(p, P(right place))

passes through p, rises with both limits from 0 to q, and is P(right place) F(a) wherever p is P(right place) F(b).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from scipy.special import log_ndtr
from torch import Tensor

from wheretolook.dataset.thresholds import Accuracy
from wheretolook.geometry.poses import Float
from wheretolook.scorers.set.network import ALL_STATISTICS, SetNetwork
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.errors import WeightsError
from wheretolook.utils.probability import finite_log_odds
from wheretolook.utils.reading import read_json_object
from wheretolook.utils.shipped_model import LogisticRegression


@dataclass(frozen=True)
class LogError:
    """Normal distribution of the log of an error: its mean is linear in `STATISTICS`."""

    weights: tuple[float, ...]
    bias: float
    deviation: float


STATISTICS = ("log_visible", "log_orientation_variance", "log_expected_cells")
"""Features of the errors. None depends on the unit of length: errors scale with the deviation of the position."""

FEATURES = [ALL_STATISTICS.index(name) for name in STATISTICS]
MARGIN = 1e-5  # of probabilities from 0 and 1, so that their log-odds are finite


@dataclass(frozen=True)
class AccuracyModel(LogisticRegression):
    """Both factors."""

    names = ("log_odds", "log_orientation_variance")
    about = "the accuracy of views"
    file = Path(__file__).with_name("accuracy.json")

    errors: tuple[LogError, ...] = ()  # of the position over its expected deviation, and of the orientation in degrees

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read the JSON file of both factors. Raises a WeightsError if it is damaged."""
        place = super().load(path)
        try:
            stored: Any = read_json_object(path)["errors"]
            errors = tuple(
                LogError(
                    tuple(float(one["weights"][name]) for name in STATISTICS),
                    float(one["bias"]),
                    float(one["deviation"]),
                )
                for one in (stored["position"], stored["orientation"])
            )
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise WeightsError(f"a damaged file of {cls.about}: {error}", path=path, fix="Fit it again.") from error
        return cls(place.weights, place.bias, errors)

    @property
    def _deviations(self) -> Float:
        return np.array([error.deviation for error in self.errors])

    def p_right_place(self, own: Float, statistics: Float) -> Float:
        """Return P(right place) (B,) of views with the network's probabilities (B,) and `ALL_STATISTICS` (B, S)."""
        variance = statistics[:, ALL_STATISTICS.index("log_orientation_variance")]
        return self.predict_proba(np.stack([finite_log_odds(own, MARGIN), variance], axis=-1))

    def log_errors(self, statistics: Float) -> Float:
        """Return the means (B, 2) of the logs of the errors (m, degrees) at the right place."""
        weights = np.array([error.weights for error in self.errors])
        means = statistics[:, FEATURES] @ weights.T + [error.bias for error in self.errors]
        means[:, 0] += statistics[:, ALL_STATISTICS.index("log_position_variance")] / 2
        return np.asarray(means)

    def expected_errors(self, statistics: Float) -> Float:
        """Return the expected errors (B, 2) at the right place, in metres and degrees."""
        return np.asarray(np.exp(self.log_errors(statistics) + self._deviations**2 / 2))

    def log_p_within(self, statistics: Float, accuracy: Accuracy) -> Float:
        """Return the log (B,) of F at an accuracy."""
        return np.asarray(log_ndtr((np.log(accuracy) - self.log_errors(statistics)) / self._deviations).min(axis=-1))

    def at(self, accuracy: Accuracy, own: Accuracy, probability: Float, statistics: Float) -> Float:
        """Return probabilities (B,) at an accuracy from those (B,) at a network's own accuracy, and `ALL_STATISTICS`."""
        asked, known = (self.log_p_within(statistics, limits) for limits in (accuracy, own))
        place = np.maximum(probability, self.p_right_place(probability, statistics))
        missed = np.expm1(np.minimum(known, -np.finfo(float).tiny))
        share = 1 - np.expm1(np.maximum(asked, known)) / missed
        return np.where(
            asked <= known,
            probability * np.exp(np.minimum(asked - known, 0)),
            probability + (place - probability) * share,
        )


def probabilities(
    trained: TrainedNetwork[SetNetwork],
    accuracy: Accuracy,
    sums: Tensor,
    n_visible: Tensor,
    axis_height: Tensor,
    cells: Tensor,
) -> Float:
    """Return the probabilities (B,) of views to localize within an accuracy; other arguments as of `SetNetwork.logits`."""
    with torch.inference_mode():
        logits = trained.network.logits(sums, n_visible, axis_height, cells).double()
        own = np.asarray(trained.calibrated(logits).sigmoid().cpu().numpy())
    if accuracy == trained.accuracy:
        return own
    statistics = statistics_of(trained.network, sums, n_visible, axis_height, cells)
    return AccuracyModel.bundled().at(accuracy, trained.accuracy, own, statistics)


def statistics_of(network: SetNetwork, *view: Tensor) -> Float:
    """Return `ALL_STATISTICS` (B, S) of views; arguments as of `SetNetwork.logits`."""
    with torch.inference_mode():
        return np.asarray(network.statistics_of(*view).double().cpu().numpy())
