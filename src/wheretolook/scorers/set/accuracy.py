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

Errors on maps of photographs follow from more than the network knows: how precise their keypoints are, and their
landmarks. The observed errors of held-out photographs over those of the network's covariance differ by factors of 0.2 to
5 between maps; over the deviation by the tracks of the landmarks and the keypoint noise of the map (`MAPPED_DEVIATIONS`)
by a factor of 1.7 to either side. So P(a) = P(right place) F(a) there, with this deviation in F.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import log
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from scipy.special import log_ndtr

from wheretolook.dataset.config import Accuracy
from wheretolook.geometry.poses import Float
from wheretolook.localization.confidence import LogisticRegression
from wheretolook.scorers.set.network import MAPPED_DEVIATIONS, VIEW_STATISTICS, SetNetwork, ViewSums, mapped_deviations
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.errors import WeightsError
from wheretolook.utils.files import read_json_object


@dataclass(frozen=True)
class LogError:
    """Normal distribution of the log of an error: its mean is linear in `AccuracyModel.inputs`."""

    weights: tuple[float, ...]
    bias: float
    deviation: float


STATISTICS = VIEW_STATISTICS + MAPPED_DEVIATIONS

MARGIN = 1e-5  # of probabilities from 0 and 1, so that their log-odds are finite


@dataclass(frozen=True)
class AccuracyModel(LogisticRegression):
    """Both factors.

    Methods take arrays, or tensors if `xp` is torch instead of NumPy.
    """

    names: ClassVar[tuple[str, ...]] = ("log_odds", "log_orientation_variance")
    about = "the accuracy of views"
    file = Path(__file__).with_name("accuracy.json")

    inputs: ClassVar[tuple[str, ...]] = ("log_visible", "log_orientation_variance", "log_expected_cells")
    """Features of the errors. None depends on the unit of length: errors scale with the deviation of the position."""
    powers: ClassVar[dict[str, tuple[float, float]]] = {"log_position_variance": (0.5, 0.0)}
    """Powers of the statistics that both errors are multiplied by."""

    errors: tuple[LogError, ...] = ()  # of the position over its expected deviation, and of the orientation in degrees

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read the JSON file of both factors. Raises a WeightsError if it is damaged."""
        place = super().load(path)
        try:
            stored: Any = read_json_object(path)["errors"]
            errors = tuple(
                LogError(
                    tuple(float(one["weights"][name]) for name in cls.inputs),
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

    def p_right_place(self, own: Any, statistics: Any, xp: Any = np) -> Any:
        """Return P(right place) (B,) of views with the network's probabilities (B,) and `STATISTICS` (B, S)."""
        finite = xp.clip(own, MARGIN, 1 - MARGIN)
        log_odds = self.weights[0] * xp.log(finite / (1 - finite)) + self.bias
        for weight, name in zip(self.weights[1:], self.names[1:], strict=True):
            log_odds = log_odds + weight * statistics[:, STATISTICS.index(name)]
        return 1 / (1 + xp.exp(-log_odds))

    def log_errors(self, statistics: Any, xp: Any = np) -> Any:
        """Return the means (B, 2) of the logs of the errors (m, degrees) at the right place."""
        weights = np.array([[*error.weights] for error in self.errors]).T
        weights = np.concatenate([weights.reshape(-1, 2), np.array([*self.powers.values()])])
        biases = np.array([error.bias for error in self.errors])
        columns = [STATISTICS.index(name) for name in (*self.inputs, *self.powers)]
        return statistics[:, columns] @ xp.asarray(weights) + xp.asarray(biases)

    def expected_errors(self, statistics: Float) -> Float:
        """Return the medians (B, 2) of the errors at the right place, in metres and degrees."""
        return np.asarray(np.exp(self.log_errors(statistics)))

    def quantiles(self, statistics: Any, accuracy: Accuracy, xp: Any = np) -> Any:
        """Return the quantiles (B,) of the standard normal distribution that have the probability F at an accuracy."""
        off = xp.asarray(np.log(accuracy)) - self.log_errors(statistics, xp)
        return xp.amin(off / xp.asarray(self._deviations), -1)

    def at(
        self,
        accuracy: Accuracy,
        own: Accuracy,
        probability: Any,
        statistics: Any,
        xp: Any = np,
        log_cdf: Any = log_ndtr,
    ) -> Any:
        """Return probabilities (B,) at an accuracy from those (B,) at a network's own accuracy, and `STATISTICS`.

        `log_cdf` is the log of the standard normal distribution function.
        """
        if accuracy == own:
            return probability
        asked, known = (self.quantiles(statistics, limits, xp) for limits in (accuracy, own))
        place = xp.maximum(probability, self.p_right_place(probability, statistics, xp))
        # one of both is neutral: 1 from the network's own accuracy on, 0 up to it
        factor = xp.exp(log_cdf(xp.minimum(asked, known)) - log_cdf(known))
        share = 1 - xp.exp(log_cdf(-xp.maximum(asked, known)) - log_cdf(-known))
        return probability * factor + (place - probability) * share


class PhotographModel(AccuracyModel):
    """Both factors on maps of photographs. The network's probability is only an input of the first."""

    names = ("log_odds",)
    about = "the accuracy of views on maps of photographs"
    file = Path(__file__).with_name("photographs.json")
    inputs = ()
    powers: ClassVar = dict(zip(MAPPED_DEVIATIONS, ((1.0, 0.0), (0.0, 1.0)), strict=True))

    def at(
        self,
        accuracy: Accuracy,
        own: Accuracy,
        probability: Any,
        statistics: Any,
        xp: Any = np,
        log_cdf: Any = log_ndtr,
    ) -> Any:
        """See `AccuracyModel.at`."""
        place = self.p_right_place(probability, statistics, xp)
        return place * xp.exp(log_cdf(self.quantiles(statistics, accuracy, xp)))


def model_of(trained: TrainedNetwork[SetNetwork]) -> AccuracyModel:
    """Return the model of a network's views on its map."""
    return AccuracyModel.bundled() if trained.of_map is None else PhotographModel.bundled()


def probabilities(trained: TrainedNetwork[SetNetwork], accuracy: Accuracy, views: ViewSums) -> Float:
    """Return the probabilities (B,) of views to localize within an accuracy."""
    with torch.inference_mode():
        logits = trained.network.logits(views).double()
        own = np.asarray(trained.calibrated(logits).sigmoid().cpu().numpy())
    if trained.of_map is None and accuracy == trained.accuracy:  # without further statistics
        return own
    return np.asarray(model_of(trained).at(accuracy, trained.accuracy, own, statistics_of(trained, views)))


def statistics_of(trained: TrainedNetwork[SetNetwork], views: ViewSums) -> Float:
    """Return `STATISTICS` (B, S) of views; the deviations are those of the map's `error_scale`, if it has one."""
    with torch.inference_mode():
        return np.asarray(statistics_on(trained, views).cpu().numpy())


def statistics_on(trained: TrainedNetwork[SetNetwork], views: ViewSums) -> torch.Tensor:
    """Return `statistics_of` views as a tensor."""
    of_view = trained.network.statistics_of(views).double()
    scale = 1.0 if trained.of_map is None else trained.of_map.error_scale
    return torch.cat([of_view, mapped_deviations(views, of_view) + log(scale)], 1)
