"""Train the probability that the localizer detects a visible landmark."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wheretolook.scorers.matchability.network import MatchabilityNetwork
from wheretolook.training.data import Batch, IndexBatches
from wheretolook.training.landmark_views import DISTANCES, LandmarkDataModule, random_log_scales
from wheretolook.training.learner import TrainingJob, TrainingResult, train_network


class SingleLandmarkBatches(IndexBatches):
    """Batches of landmarks (E, len(ATTRIBUTES)) in `rows` (n,), and whether each was detected (E,).

    The scenes of shuffled landmarks are scaled as by `LandmarkBatches`.
    """

    def __init__(self, values: Tensor, detected: Tensor, rows: Tensor, *options: Any, max_scale: float = 1.0) -> None:
        super().__init__(rows.to(values.device), *options)
        self.values = values
        self.detected = detected
        self.max_scale = max_scale

    def collate(self, rows: Tensor, generator: torch.Generator) -> Batch:
        """Return this process's share of the landmarks in `rows`."""
        share = self.share_of(rows)
        values = self.values[share].float()
        if self.shuffle_seed is not None:
            log_scale = random_log_scales(len(rows), self.max_scale, generator)
            if log_scale is not None:
                values[:, DISTANCES] += self.share_of(log_scale)[:, None]
        return Batch((values,), self.detected[share].float(), len(rows))


class MatchabilityDataModule(LandmarkDataModule):
    """Visible landmarks of a dataset's labelled viewpoints; a TableError if their matches are not stored."""

    def __init__(self, task: TrainingJob) -> None:
        super().__init__(task, task.options.landmarks, matches=True)

    def entries(self, rows: Tensor) -> Tensor:
        """Return the entries (n,) of the landmarks of some views."""
        chosen = torch.zeros(len(self.views), dtype=torch.bool)
        chosen[rows] = True
        return torch.nonzero(chosen.repeat_interleave(self.views.starts.cpu().diff()))[:, 0]

    def labels(self, rows: Tensor) -> NDArray[np.bool_]:
        """Return whether each landmark of some views was detected."""
        assert self.views.detected is not None
        return self.views.detected.cpu()[self.entries(rows)].numpy()

    def batches(self, rows: Tensor, shuffle_seed: int | None = None) -> SingleLandmarkBatches:
        """See `ViewsDataModule.batches`."""
        assert self.views.detected is not None
        size = self.options.batch_size * self.options.landmarks * (8 if shuffle_seed is None else 1)
        data = (self.views.values, self.views.detected, self.entries(rows))
        return SingleLandmarkBatches(*data, size, shuffle_seed, self.share, max_scale=self.options.enlarged)


def learn_matchability(task: TrainingJob) -> TrainingResult:
    """Train a `MatchabilityNetwork` on the matches that are stored with a dataset's labels.

    Raises a TableError if there is no train scene, no labels, or no stored matches.
    """
    data = MatchabilityDataModule(task)
    return train_network(MatchabilityNetwork(data.statistics, task.options.width, task.options.hidden), data, task)
