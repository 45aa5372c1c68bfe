"""Train the detection of single landmarks, and the network over the set of visible landmarks."""

from __future__ import annotations

from dataclasses import replace
from math import ceil
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wheretolook.dataset.viewpoint_files import has_matches
from wheretolook.scorers.set import SetConfig
from wheretolook.scorers.set.network import MatchabilityNetwork, SetNetwork
from wheretolook.training.data import Batch, IndexBatches, check_classes
from wheretolook.training.landmark_views import DISTANCES, LandmarkBatches, LandmarkDataModule, random_log_scales
from wheretolook.training.learner import TrainingJob, TrainingResult, train_network
from wheretolook.training.provenance import training_scenes, weights_path
from wheretolook.training.trained_network import TrainedNetwork


class SingleLandmarkBatches(IndexBatches):
    """Batches of landmarks (E, len(ATTRIBUTES)) in `rows` (n,), and whether each was detected (E,).

    The scenes of shuffled landmarks are scaled as by `LandmarkBatches`.
    """

    def __init__(self, values: Tensor, detected: Tensor, rows: Tensor, max_scale: float = 1.0, **order: Any) -> None:
        super().__init__(rows.to(values.device), **order)
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
        return SingleLandmarkBatches(
            self.views.values,
            self.views.detected,
            self.entries(rows),
            self.options.enlarged,
            batch_size=size,
            shuffle_seed=shuffle_seed,
            share=self.share,
        )


def learn_matchability(task: TrainingJob) -> TrainingResult:
    """Train a `MatchabilityNetwork` on the matches that are stored with a dataset's labels.

    Raises a TableError if there is no train scene, no labels, or no stored matches.
    """
    data = MatchabilityDataModule(task)
    return train_network(MatchabilityNetwork(data.statistics, task.options.width, task.options.hidden), data, task)


WINDOWS = 2  # landmarks stored of a view, over those in a training step's window


class SetDataModule(LandmarkDataModule):
    """The labelled viewpoints of a dataset by their landmarks; a TableError if the labels of a split are of one class."""

    def __init__(self, task: TrainingJob) -> None:
        matches = task.options.landmark_loss > 0 and all(has_matches(s.table) for s in training_scenes(task.dataset))
        super().__init__(task, WINDOWS * task.options.landmarks, matches)
        check_classes(task.dataset, self.config, self.labels(self.train_rows), self.labels(self.val_rows))

    def batches(self, rows: Tensor, shuffle_seed: int | None = None) -> LandmarkBatches:
        """Return shuffled views, every time with other windows; or views in order, always with all landmarks stored."""
        width = self.options.landmarks * (WINDOWS if shuffle_seed is None else 1)
        return LandmarkBatches(
            self.views,
            rows,
            width,
            self.options.batch_size,
            shuffle_seed,
            self.share,
            max_scale=self.options.enlarged,
            max_error_m=self.config.max_error_m,
        )


def of_size(options: SetConfig, n_train: int) -> SetConfig:
    """Return options with smaller batches and more epochs if there are few training views.

    These are cut into 16 batches, of 64 views at least, and all epochs have 600 steps at least.
    """
    if n_train // 16 >= options.batch_size:
        return options
    batch_size = min(options.batch_size, max(64, n_train // 16))
    enough = ceil(600 / ceil(n_train / batch_size))
    return replace(options, batch_size=batch_size, epochs=max(options.epochs, enough))


def learn_set(task: TrainingJob, data: SetDataModule | None = None) -> TrainingResult:
    """Train a set network on a dataset's labels, or on views that are described already.

    Detection of landmarks is trained with it: on stored matches, if all tables have them, and through the labels. If the
    dataset's `weights` folder has a matchability model of the same width, training starts from that.

    Raises:
        TableError: there is no train scene, no labels, or the labels of a split are of one class.
        WeightsError: the matchability model is damaged.
    """
    data = data or SetDataModule(task)
    options = data.options = of_size(task.options, len(data.train_rows))
    statistics = data.statistics
    path = weights_path(task.dataset, options.starts_from)
    start = None
    if options.starts_from and path.is_file():
        start = TrainedNetwork.load(path, MatchabilityNetwork, options.starts_from).network
        statistics = start.statistics if start.attributes == statistics.names else statistics
    network = SetNetwork(statistics, options.width, options.head, options.dropout, options.hidden)
    if start is not None and (start.statistics, start.options) == (statistics, network.matchability.options):
        network.matchability.load_state_dict(start.state_dict())
    return train_network(network, data, replace(task, options=options))
