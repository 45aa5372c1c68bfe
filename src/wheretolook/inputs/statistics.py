"""Mean and standard deviation of a network's inputs over its training views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Any

import torch
from torch import Tensor

from wheretolook.inputs.channels import ATTRIBUTES

BLOCK = 256  # views processed at a time: few enough for a processor's cache


@dataclass(frozen=True)
class FeatureStatistics:
    """Mean and standard deviation of named inputs, each in its own unit, over the values that are known."""

    names: tuple[str, ...]
    mean: tuple[float, ...]
    std: tuple[float, ...]

    @classmethod
    def of_bins(cls, means: Tensor, filled: Tensor, rows: Tensor, channels: tuple[str, ...]) -> FeatureStatistics:
        """Compute statistics of channels over the filled bins of views `rows` (n,) int64.

        Means (B, C, bins, bins) are zero where bins are not `filled` (B, bins, bins), and NaN where a value is unknown.
        The deviation is 1 where it would be 0, and infinite where no value is known, so that a network ignores a
        channel it has never seen.
        """
        rows = rows.to(means.device)
        total = torch.zeros(len(channels), dtype=torch.float64, device=means.device)
        n_filled = torch.zeros_like(total)
        unknown = torch.zeros_like(total)
        for block in rows.split(BLOCK):  # empty bins are zero: they add nothing to the sum
            values = means[block]
            n_filled += filled[block].sum()
            unknown += values.isnan().sum((0, 2, 3))
            total += values.nan_to_num_().sum((0, 2, 3), dtype=torch.float64)
        count = (n_filled - unknown).clamp(min=1)
        mean = total / count
        squares = torch.zeros_like(total)
        for block in rows.split(BLOCK):  # a second pass: no cancellation between large numbers
            centred = (means[block] - mean.float()[:, None, None]) * filled[block][:, None]
            squares += centred.nan_to_num_().square_().sum((0, 2, 3), dtype=torch.float64)
        std = (squares / count).sqrt()
        std = torch.where(std > 0, std, 1.0)
        std = torch.where((n_filled > 0) & (unknown == n_filled), torch.inf, std)
        return cls(channels, tuple(mean.tolist()), tuple(std.tolist()))

    @classmethod
    def of_attributes(cls, values: Tensor) -> FeatureStatistics:
        """Compute statistics of `ATTRIBUTES` over landmarks (E, A), NaN where unknown; 0 and 1 where none is known."""
        means = []
        stds = []
        for column in values.unbind(1):
            known = column[~column.isnan()].double()
            mean = float(known.mean()) if len(known) else 0.0
            std = float((known - mean).square().mean().sqrt()) if len(known) else 0.0
            means.append(mean)
            stds.append(std if std > 1e-6 else 1.0)
        return cls(ATTRIBUTES, tuple(means), tuple(stds))

    @classmethod
    def of_record(cls, names: tuple[str, ...], record: Mapping[str, Any], known: tuple[str, ...]) -> FeatureStatistics:
        """Return the statistics of named inputs that a `record` stores; ValueError if one is invalid or not `known`."""
        mean, std = (tuple(map(float, record[key])) for key in ("mean", "std"))
        if unknown := {*names} - {*known}:
            raise ValueError(f"this version has no input {min(unknown)}")
        if not len(mean) == len(std) == len(names) or not all(map(isfinite, mean)) or not all(x > 0 for x in std):
            raise ValueError(f"invalid means {mean} and deviations {std} of {len(names)} inputs")
        return cls(names, mean, std)

    def record(self) -> dict[str, Any]:
        """Return means and deviations as JSON values."""
        return {"mean": self.mean, "std": self.std}

    def select(self, names: tuple[str, ...]) -> FeatureStatistics:
        """Return the statistics of some inputs."""
        index = [self.names.index(name) for name in names]
        return FeatureStatistics(names, tuple(self.mean[i] for i in index), tuple(self.std[i] for i in index))
