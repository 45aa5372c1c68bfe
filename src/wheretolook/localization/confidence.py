"""Predicts the probability that a pose is right within any accuracy, from what a robot knows without ground truth.

Where a map resembles itself, a wrong pose can have a hundred inliers. But then a competing pose has nearly as many, or
has fewer that the ambiguity does not explain; the right pose explains all views much better than any competing pose.

P(error below t) = P(right place) P(error below t | right place). A logistic regression predicts the first factor. In the
second, the log of an error is normal, with a mean linear in the log of the standard deviation that the inliers give the
pose. Errors of position and orientation correlate at 0.84, so the smaller of their two probabilities is used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.dataset.config import Accuracy
from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import WeightsError
from wheretolook.utils.files import read_json_object


@dataclass(frozen=True)
class LogisticRegression:
    """Base class: a subclass names its features, what it predicts (`about`) and its bundled file."""

    names: ClassVar[tuple[str, ...]]
    about: ClassVar[str]
    file: ClassVar[Path]

    weights: tuple[float, ...]
    bias: float

    @classmethod
    @cache
    def bundled(cls) -> Self:
        """Return the bundled model, fitted on validation scenes."""
        return cls.load(cls.file)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a JSON file of weights by name and a bias. Raises a WeightsError if it is damaged."""
        try:
            stored = read_json_object(path)
            model = cls(tuple(float(stored["weights"][name]) for name in cls.names), float(stored["bias"]))
            if not np.isfinite([*model.weights, model.bias]).all():
                raise ValueError("a weight is not finite")
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise WeightsError(f"a damaged file of {cls.about}: {error}", path=path, fix="Fit it again.") from error
        return model

    def predict_proba(self, features: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Return probabilities (...,) for feature vectors (..., K) in the order of `names`."""
        return np.asarray(1 / (1 + np.exp(-self.log_odds(features))))

    def log_odds(self, features: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Return the log-odds (...,) of `predict_proba`, within -60 and 60."""
        return np.asarray(np.clip(features @ np.asarray(self.weights) + self.bias, -60, 60))


RIGHT_PLACE: Accuracy = (math.inf, math.inf)
"""Accuracy that every pose at the right place has: within `RIGHT_PLACE_LIMITS` of the true one."""

RIGHT_PLACE_LIMITS: Accuracy = (0.5, 5.0)

ERRORS_ON_PHOTOGRAPHS = 1.7
"""Errors of poses on maps of photographs over those on maps of renders, for equal residuals of the inliers: landmarks of
photographs share errors that do not average out (`wheretolook_paper.studies.fit_photographs`)."""

MIN_INLIERS = 10  # with fewer, the localizer itself rejects a pose


def log_ratio(unique: ArrayLike, rival_unique: ArrayLike) -> Float:
    """Log ratio of the unique support (...,) of two poses, both smoothed by 10: 1 against 0 is not decisive."""
    smoothed = np.asarray(unique, dtype=np.float64) + 10.0
    return np.log(smoothed / (np.asarray(rival_unique, dtype=np.float64) + 10.0))


def confidence_features(
    n_inliers: ArrayLike,
    n_matches: ArrayLike,
    rival_support: ArrayLike,
    unique_support: ArrayLike,
    rival_unique_support: ArrayLike,
    deviation_deg: ArrayLike,
) -> Float:
    """Features (B, 4) of B joint poses, see `ConfidenceModel`."""
    inlier_ratio = (np.asarray(n_inliers, dtype=np.float64) + 0.5) / (np.asarray(n_matches, dtype=np.float64) + 1)
    deviation = np.clip(np.asarray(deviation_deg, dtype=np.float64), 1e-4, 10.0)
    support_ratio = log_ratio(unique_support, rival_unique_support)
    rival = np.log1p(np.asarray(rival_support, dtype=np.float64))
    return np.stack([rival, np.log(inlier_ratio), support_ratio, np.log(deviation)], axis=-1)


@dataclass(frozen=True)
class ErrorModel:
    """Log-normal distribution of an error: log(error) has the mean slope * log(predicted deviation) + offset."""

    slope: float
    offset: float
    deviation: float  # of the log

    def p_below(self, limit: float, predicted: float) -> float:
        """Probability that the error is below a limit, given its predicted standard deviation in the same unit."""
        if math.isinf(limit):
            return 1.0
        if not (predicted > 0 and math.isfinite(predicted)):
            return float(predicted == 0)
        z = (math.log(limit) - self.slope * math.log(predicted) - self.offset) / self.deviation
        return 0.5 * math.erfc(-z / math.sqrt(2))


@dataclass(frozen=True)
class ConfidenceModel(LogisticRegression):
    """Probability that a pose is right within an accuracy; 0 with fewer inliers than `MIN_INLIERS`, at most 0.5 below 12."""

    # log(1 + support of the best competing pose), log of the inlier ratio of the matches, log of the ratio of this
    # pose's unique support to that of its strongest rival (`log_ratio`), log of one standard deviation of the
    # orientation (degrees)
    names = ("log_elsewhere", "log_share", "log_own", "log_deviation_deg")
    about = "confidence"
    file = Path(__file__).with_name("confidence.json")

    errors: tuple[ErrorModel, ...] = ()  # of the position (m) and of the orientation (degrees)
    # where the share of missing landmarks is known: slope of the log-odds of the right place without it, weight of its
    # log, and bias
    by_missing: tuple[float, float, float] = (1.0, 0.0, 0.0)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read the JSON file of both factors."""
        place = super().load(path)
        stored = read_json_object(path)
        errors = tuple(ErrorModel(**stored["errors"][name]) for name in ("position", "orientation"))
        slope, weight, bias = (float(stored["missing"][name]) for name in ("slope", "weight", "bias"))
        return cls(place.weights, place.bias, errors, (slope, weight, bias))

    def p_within(
        self,
        n_inliers: int,
        n_matches: int,
        rival_support: float,
        unique_support: tuple[int, int],
        deviation: tuple[float, float],
        accuracy: Accuracy,
        missing: float | None = None,
    ) -> float:
        """Probability that a pose is within an accuracy, given attributes of its `JointLocalization`.

        `missing` is the share of the landmarks expected where none is found (`ExpectedLandmarks`); None if unknown.
        """
        if n_inliers < MIN_INLIERS:
            return 0.0
        unique, rival_unique = unique_support
        features = confidence_features(n_inliers, n_matches, rival_support, unique, rival_unique, deviation[1])
        limits = zip(self.errors, accuracy, deviation, strict=True)
        log_odds = float(self.log_odds(features))
        if missing is not None:
            slope, weight, bias = self.by_missing
            # few poses are surer, and however many inliers cannot outweigh what is missing
            log_odds = slope * float(np.clip(log_odds, -7, 7)) + weight * math.log(max(missing, 0.02)) + bias
        place = 1 / (1 + math.exp(-log_odds))
        probability = place * min(model.p_below(limit, own) for model, limit, own in limits)
        # random matches of features that hardly match reach eleven inliers, with which poses were not fitted
        return probability if n_inliers >= 12 else min(probability, 0.5)
