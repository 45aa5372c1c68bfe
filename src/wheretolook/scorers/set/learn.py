"""Learning to score views by the set of landmarks they see."""

from __future__ import annotations

from dataclasses import replace
from math import ceil

from torch import Tensor

from wheretolook.dataset.viewpoint_table import has_matches
from wheretolook.scorers.matchability.network import MatchabilityNetwork
from wheretolook.scorers.set.config import SetConfig
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.training.data import check_classes
from wheretolook.training.landmark_views import LandmarkDataModule, LandmarkLoader
from wheretolook.training.learner import Learnt, Task, class_counts, fit_network, fit_platt, predict
from wheretolook.training.provenance import weights_path
from wheretolook.training.scenes import training_scenes
from wheretolook.training.trained_network import TrainedNetwork


class SetData(LandmarkDataModule):
    """The labelled viewpoints of a dataset, by the landmarks they see; a TableError if labels are of one class only."""

    def __init__(self, task: Task) -> None:
        matches = task.options.landmark_loss > 0 and all(has_matches(s.table) for s in training_scenes(task.dataset))
        super().__init__(task, MOST_OF_WINDOW * task.options.landmarks, matches)
        positive = (self.views.labels > 0).numpy()
        check_classes(task.dataset, self.config, positive[self.train_rows], positive[self.val_rows])

    def batches(self, rows: Tensor, shuffle_seed: int | None = None) -> LandmarkLoader:
        """Shuffled views, another sample of each one's landmarks every time; or in order, always with the same."""
        options = self.options
        limit_m = self.config.max_error_m
        width = options.landmarks * (MOST_OF_WINDOW if shuffle_seed is None else 1)
        return LandmarkLoader(
            self.views, rows, options.batch_size, width, shuffle_seed, *self.share, options.enlarged, limit_m
        )


MOST_OF_WINDOW = 2  # landmarks kept of a view, over those that a training step looks at


LEAST_BATCHES = 16
LEAST_BATCH = 64
LEAST_STEPS = 600
"""Batches that the training views are cut into at least, views of a batch at least, steps in all at least."""


def of_size(options: SetConfig, n_train: int) -> SetConfig:
    """Options for so many training views: few are gone through in smaller batches, and more often."""
    batch_size = min(options.batch_size, max(LEAST_BATCH, n_train // LEAST_BATCHES))
    enough = ceil(LEAST_STEPS / ceil(n_train / batch_size))
    if n_train // LEAST_BATCHES >= options.batch_size:
        return options
    return replace(options, batch_size=batch_size, epochs=max(options.epochs, enough))


def learn_set(task: Task, data: SetData | None = None) -> Learnt:
    """A set network from a dataset's labels, or from its views, if they have been described already.

    Whether landmarks are found it learns on the way: from the stored matches if all tables have them, so that these
    chances stay true, and from the labels. If the dataset's `weights` folder has a matchability model of the same
    width, it starts from that.

    Raises a TableError if there is no train scene, no labels, or labels of one class only; a WeightsError if the
    matchability model is damaged.
    """
    data = data or SetData(task)
    options = data.options = of_size(task.options, len(data.train_rows))
    statistics = data.statistics
    path = weights_path(task.dataset, options.starts_from)
    start = None
    if options.starts_from and path.is_file():
        start = TrainedNetwork.load(path, MatchabilityNetwork, options.starts_from).network
        statistics = start.statistics if start.attributes == statistics.attributes else statistics
    network = SetNetwork(statistics, options.width, options.pooled, options.head, options.dropout, options.hidden)
    if start is not None and (start.statistics, start.options) == (statistics, network.matchability.options):
        network.matchability.load_state_dict(start.state_dict())
    metrics, history = fit_network(network, data, replace(task, options=options))
    logits, labels = predict(network, data)
    counts = class_counts(train=data.views.labels[data.train_rows].cpu().numpy(), val=labels)
    model = TrainedNetwork(task.method, network, task.camera, *fit_platt(logits, labels), data.training_range)
    return Learnt(model, metrics, counts, history)
