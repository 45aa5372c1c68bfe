"""Train the probability that the localizer detects a visible landmark."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from wheretolook.scorers.matchability.network import MatchabilityNetwork
from wheretolook.training.batches import Batch, IndexBatches
from wheretolook.training.landmark_views import DISTANCES, LandmarkDataModule, random_log_scales
from wheretolook.training.learner import TrainingJob, TrainingResult, class_counts, fit_network, fit_platt, predict
from wheretolook.training.trained_network import TrainedNetwork


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
        log_scale = None
        if self.shuffle_seed is not None:
            log_scale = random_log_scales(len(rows), self.max_scale, generator)
        if log_scale is not None:
            values[:, DISTANCES] += self.share_of(log_scale)[:, None]
        return Batch((values,), self.detected[share].float(), len(rows))


class MatchabilityDataModule(LandmarkDataModule):
    """Visible landmarks of a dataset's labelled viewpoints; a TableError if their matches are not stored."""

    def __init__(self, task: TrainingJob) -> None:
        super().__init__(task, task.options.landmarks, matches=True)

    @property
    def detected(self) -> Tensor:
        """Whether the localizer detected each entry's landmark, (E,) bool."""
        assert self.views.detected is not None
        return self.views.detected

    def entries(self, rows: Tensor) -> Tensor:
        """Return the entries (n,) of the landmarks of some views."""
        chosen = torch.zeros(len(self.views), dtype=torch.bool)
        chosen[rows] = True
        return torch.nonzero(chosen.repeat_interleave(self.views.starts.cpu().diff()))[:, 0]

    def batches(self, rows: Tensor, shuffle_seed: int | None = None) -> SingleLandmarkBatches:
        """See `ViewsDataModule.batches`."""
        size = self.options.batch_size * self.options.landmarks * (8 if shuffle_seed is None else 1)
        data = (self.views.values, self.detected, self.entries(rows))
        return SingleLandmarkBatches(*data, size, shuffle_seed, self.share, max_scale=self.options.enlarged)


def learn_matchability(task: TrainingJob) -> TrainingResult:
    """Train a `MatchabilityNetwork` on the matches that are stored with a dataset's labels.

    Raises a TableError if there is no train scene, no labels, or no stored matches.
    """
    data = MatchabilityDataModule(task)
    network = MatchabilityNetwork(data.statistics, task.options.width, task.options.hidden)
    metrics, history = fit_network(network, data, task)
    logits, detected = predict(network, data)
    counts = class_counts(train=data.detected.cpu()[data.entries(data.train_rows)].numpy(), val=detected)
    model = TrainedNetwork(task.method, network, task.camera, *fit_platt(logits, detected), data.training_range)
    return TrainingResult(model, metrics, counts, history)
