"""Shuffled batches of training examples, cut by index from tensors that are in memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import ceil
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor


class Batch(NamedTuple):
    """One process's share of a batch."""

    inputs: tuple[Tensor, ...]  # of the network, tensors with B rows
    labels: Tensor  # (B,) float32
    total: int  # examples in the whole batch, over all processes


class IndexBatches(ABC):
    """Batches of the examples in `rows` (n,), without workers or work for a single example.

    Every process cuts the same batches of `batch_size` and keeps its `share` of each, (its rank, the number of
    processes). Shares differ by one example at most and may be empty, so that all processes take equally many steps.
    With a `shuffle_seed` every pass has its own order, the same in every run; None keeps the order of `rows`. The order
    is drawn by NumPy if `numpy_order`, else by the generator that `collate` is called with.
    """

    numpy_order = False

    def __init__(
        self, rows: Tensor, batch_size: int, shuffle_seed: int | None = None, share: tuple[int, int] = (0, 1)
    ) -> None:
        self.rows = rows
        self.batch_size = batch_size
        self.shuffle_seed = shuffle_seed
        self.share = share
        self._passes = 0

    def __len__(self) -> int:
        return ceil(len(self.rows) / self.batch_size)

    def __iter__(self) -> Iterator[Batch]:
        rows = self.rows
        generator = torch.Generator(rows.device)
        if self.shuffle_seed is not None:
            generator.manual_seed(1_000_003 * self.shuffle_seed + self._passes)
            if self.numpy_order:
                rng = np.random.default_rng([self.shuffle_seed, self._passes])
                rows = rows[torch.from_numpy(rng.permutation(len(rows))).to(rows.device)]
            else:
                rows = rows[torch.randperm(len(rows), generator=generator, device=rows.device)]
            self._passes += 1
        for part in rows.split(self.batch_size):
            yield self.collate(part, generator)

    def share_of(self, whole: Tensor) -> Tensor:
        """Return this process's part of a tensor with a row for each example of a batch."""
        rank, world_size = self.share
        return whole.tensor_split(world_size)[rank]

    @abstractmethod
    def collate(self, rows: Tensor, generator: torch.Generator) -> Batch:
        """Return this process's share of a whole batch of rows, with random numbers of the generator if shuffled."""


@dataclass(frozen=True, eq=False)
class TensorViews:
    """Labelled viewpoints, described by tensors of one device and by arrays."""

    def _tensors(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}

    def to(self, device: torch.device | str) -> Self:
        """Return the same views with their tensors on a device."""
        return replace(self, **{name: value.to(device) for name, value in self._tensors().items()})

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return next(value.device for value in self._tensors().values())

    @property
    def n_bytes(self) -> int:
        """Memory of the tensors."""
        return sum(value.nbytes for value in self._tensors().values())
