"""What a set of looks is worth: the probability that they localize together, by what they can be expected to find."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from wheretolook.geometry.poses import Float
from wheretolook.looks.union import EXPECTED_OF_SET, expected_of
from wheretolook.utils.errors import WeightsError
from wheretolook.utils.reading import read_json_object

SHIPPED = Path(__file__).with_name("worth.json")


@dataclass(frozen=True)
class SetWorth:
    """A logistic regression on `EXPECTED_OF_SET`: one model for sets of any size, single looks among them."""

    weights: tuple[float, ...]
    bias: float

    @classmethod
    @cache
    def shipped(cls) -> SetWorth:
        """That which ships, fitted on validation scenes to sets of 1 to 5 looks drawn at random."""
        return cls.load(SHIPPED)

    @classmethod
    def load(cls, path: Path) -> SetWorth:
        """Read a JSON file of weights by name and a bias. Raises a WeightsError if it is damaged."""
        try:
            stored = read_json_object(path)
            made = cls(tuple(float(stored["weights"][name]) for name in EXPECTED_OF_SET), float(stored["bias"]))
            if not np.isfinite([*made.weights, made.bias]).all():
                raise ValueError("a weight is not finite")
        except (OSError, ValueError, KeyError, TypeError) as error:
            fix = "Install the package again, or fit it anew."
            raise WeightsError(f"a damaged file of what looks are worth: {error}", path=path, fix=fix) from error
        return made

    def __call__(self, sums: Float) -> Float:
        """Probabilities (B,) of sets from their sums (B, N_SUMS)."""
        logits = expected_of(np.asarray(sums)) @ np.asarray(self.weights) + self.bias
        return np.asarray(1 / (1 + np.exp(-np.clip(logits, -60, 60))))


def fisher_worth(sums: Float) -> Float:
    """For comparison: log det of the information, (B,), as of `fisher.metrics`; with exact chances that of the rig."""
    from wheretolook.fisher.metrics import metric_of

    return metric_of(np.asarray(sums)[..., 1:], "logdet")


def count_worth(sums: Float) -> Float:
    """For comparison: how many different landmarks are expected to be found, (B,)."""
    return np.asarray(sums)[..., 0]
