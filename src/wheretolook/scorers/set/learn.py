"""Train the network over the set of visible landmarks."""

from __future__ import annotations

from dataclasses import replace
from math import ceil

from torch import Tensor

from wheretolook.dataset.viewpoint_files import has_matches
from wheretolook.scorers.matchability.network import MatchabilityNetwork
from wheretolook.scorers.set.config import SetConfig
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.training.data import check_classes
from wheretolook.training.landmark_views import LandmarkBatches, LandmarkDataModule
from wheretolook.training.learner import TrainingJob, TrainingResult, train_network
from wheretolook.training.provenance import weights_path
from wheretolook.training.scenes import training_scenes
from wheretolook.training.trained_network import TrainedNetwork

WINDOWS = 2  # landmarks stored of a view, over those in a training step's window
MIN_BATCHES = 16  # that the training views are cut into
MIN_BATCH_SIZE = 64
MIN_STEPS = 600  # of all epochs


class SetDataModule(LandmarkDataModule):
    """The labelled viewpoints of a dataset by their landmarks; a TableError if the labels of a split are of one class."""

    def __init__(self, task: TrainingJob) -> None:
        matches = task.options.landmark_loss > 0 and all(has_matches(s.table) for s in training_scenes(task.dataset))
        super().__init__(task, WINDOWS * task.options.landmarks, matches)
        check_classes(task.dataset, self.config, self.labels(self.train_rows), self.labels(self.val_rows))

    def batches(self, rows: Tensor, shuffle_seed: int | None = None) -> LandmarkBatches:
        """Return shuffled views, every time with other windows; or views in order, always with all landmarks stored."""
        width = self.options.landmarks * (WINDOWS if shuffle_seed is None else 1)
        order = self.options.batch_size, shuffle_seed, self.share
        scaling = {"max_scale": self.options.enlarged, "max_error_m": self.config.max_error_m}
        return LandmarkBatches(self.views, rows, width, *order, **scaling)


def of_size(options: SetConfig, n_train: int) -> SetConfig:
    """Return options with smaller batches and more epochs if there are few training views."""
    batch_size = min(options.batch_size, max(MIN_BATCH_SIZE, n_train // MIN_BATCHES))
    enough = ceil(MIN_STEPS / ceil(n_train / batch_size))
    if n_train // MIN_BATCHES >= options.batch_size:
        return options
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
    network = SetNetwork(statistics, options.width, options.pooled, options.head, options.dropout, options.hidden)
    if start is not None and (start.statistics, start.options) == (statistics, network.matchability.options):
        network.matchability.load_state_dict(start.state_dict())
    return train_network(network, data, replace(task, options=options))
