"""Statistics of landmark attributes over training views, without Lightning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

from torch import Tensor

from wheretolook.inputs.channels import ATTRIBUTES
from wheretolook.utils.errors import WeightsError


@dataclass(frozen=True)
class AttributeStatistics:
    """Mean and standard deviation of the known attributes of landmarks visible in training."""

    mean: tuple[float, ...]  # (A,), 0 where no value is known
    std: tuple[float, ...]  # (A,), 1 where it would be 0
    attributes: tuple[str, ...] = ATTRIBUTES  # names of the A attributes

    @classmethod
    def of(cls, values: Tensor) -> AttributeStatistics:
        """Compute statistics over landmarks (E, len(ATTRIBUTES)); unknown values are NaN."""
        means = []
        stds = []
        for column in values.unbind(1):
            known = column[~column.isnan()].double()
            mean = float(known.mean()) if len(known) else 0.0
            std = float((known - mean).square().mean().sqrt()) if len(known) else 0.0
            means.append(mean)
            stds.append(std if std > 1e-6 else 1.0)
        return cls(tuple(means), tuple(stds))


def mean_and_std(stored: Mapping[str, Any], names: Sequence[str]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return means and deviations of named values from the header of weights.

    Raises a WeightsError unless there is a finite mean and a positive, possibly infinite deviation for each name;
    KeyError, TypeError or ValueError if they are no numbers.
    """
    mean, std = (tuple(float(value) for value in stored[key]) for key in ("mean", "std"))
    if not len(mean) == len(std) == len(names) or not all(map(isfinite, mean)) or not all(value > 0 for value in std):
        raise WeightsError(f"invalid means and deviations of {len(names)} values", value=(mean, std))
    return mean, std
