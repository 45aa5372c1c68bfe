"""Statistics of landmarks' attributes over training views. Apart from learning, so that scoring needs no Lightning."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from wheretolook.inputs.channels import ATTRIBUTES


@dataclass(frozen=True)
class AttributeStatistics:
    """Mean and standard deviation of what is known of each landmark, over those in view while training."""

    mean: tuple[float, ...]  # (A,), 0 for what is not known of any
    std: tuple[float, ...]  # (A,), 1 where it would be 0
    attributes: tuple[str, ...] = ATTRIBUTES  # names of the A attributes

    @classmethod
    def of(cls, values: Tensor) -> AttributeStatistics:
        """Statistics over landmarks (E, len(ATTRIBUTES)), some numbers NaN."""
        means, stds = [], []
        for column in values.unbind(1):
            known = column[~column.isnan()].double()
            mean = float(known.mean()) if len(known) else 0.0
            std = float((known - mean).square().mean().sqrt()) if len(known) else 0.0
            means.append(mean)
            stds.append(std if std > 1e-6 else 1.0)
        return cls(tuple(means), tuple(stds))
