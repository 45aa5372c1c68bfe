"""Logistic regressions that ship as a JSON file of weights by name: a few numbers in, a probability out."""

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
    """Each kind names the numbers it goes by, and says what it tells and in which file it ships."""

    names: ClassVar[tuple[str, ...]]
    about: ClassVar[str]
    file: ClassVar[Path]

    weights: tuple[float, ...]
    bias: float

    @classmethod
    @cache
    def shipped(cls) -> Self:
        """That which ships, fitted on validation scenes."""
        return cls.load(cls.file)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a JSON file of weights by name and a bias. Raises a WeightsError if it is damaged."""
        try:
            stored = read_json_object(path)
            made = cls(tuple(float(stored["weights"][name]) for name in cls.names), float(stored["bias"]))
            if not np.isfinite([*made.weights, made.bias]).all():
                raise ValueError("a weight is not finite")
        except (OSError, ValueError, KeyError, TypeError) as error:
            fix = "Install the package again, or fit it anew."
            raise WeightsError(f"a damaged file of {cls.about}: {error}", path=path, fix=fix) from error
        return made

    def probabilities(self, told: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """(...,) of the numbers it goes by, (..., K) in the order of their names."""
        return np.asarray(1 / (1 + np.exp(-np.clip(told @ np.asarray(self.weights) + self.bias, -60, 60))))
