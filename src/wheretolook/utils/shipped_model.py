"""Logistic regressions bundled as JSON files of weights by feature name."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from wheretolook.utils.errors import WeightsError
from wheretolook.utils.reading import read_json_object


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
        return np.asarray(1 / (1 + np.exp(-np.clip(features @ np.asarray(self.weights) + self.bias, -60, 60))))
