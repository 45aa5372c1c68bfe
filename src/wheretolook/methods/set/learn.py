"""Learning to score views by the set of landmarks they see."""

from __future__ import annotations

from dataclasses import replace
from math import ceil
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from wheretolook.inputs.landmarks_in_view import ViewLandmarks
from wheretolook.learning.config import MATCHABILITY, SET, TrainConfig, weights_name
from wheretolook.learning.data import check_classes
from wheretolook.learning.landmark_model import LandmarkModel
from wheretolook.learning.landmark_views import LandmarkDataModule, LandmarkLoader
from wheretolook.learning.learner import Learnt, Task, class_counts, fit_network, predict
from wheretolook.learning.platt import fit_platt
from wheretolook.methods.matchability.learn import Matchability
from wheretolook.methods.set.network import SetNetwork


class SetModel(LandmarkModel):
    """The probability that a view localizes, from the set of landmarks it sees."""

    kind: ClassVar[str] = SET
    network_class: ClassVar[type[nn.Module]] = SetNetwork

    def log_odds(self, landmarks: ViewLandmarks, visible: Tensor, axis_height: Tensor) -> Tensor:
        """Calibrated log-odds (B,) float64 of views by `SetNetwork.score`, all on the network's device."""
        with torch.inference_mode():
            logits: Tensor = self.network.score(landmarks, visible, axis_height)
            return self.scale * logits.double() + self.offset


class SetData(LandmarkDataModule):
    """The labelled viewpoints of a dataset, by the landmarks they see.

    Args:
        task: what to learn from.

    Raises:
        TableError: no train scene, no labels, or labels of one class only.
    """

    def __init__(self, task: Task) -> None:
        super().__init__(task, MOST_OF_WINDOW * task.config.set.landmarks)
        for name, rows in (("training", self.train_rows), ("validation", self.val_rows)):
            check_classes(name, self.views.labels[rows].numpy() > 0, task.dataset, self.config)

    def train_dataloader(self) -> LandmarkLoader:
        """Shuffled views, another sample of each one's landmarks every time."""
        return self._loader(self.train_rows, 1, self.config.seed)

    def val_dataloader(self) -> LandmarkLoader:
        """Views in order, with the same landmarks every time."""
        return self._loader(self.val_rows, MOST_OF_WINDOW)

    def _loader(self, rows: Tensor, windows: int, shuffle_seed: int | None = None) -> LandmarkLoader:
        width = windows * self.config.set.landmarks
        return LandmarkLoader(
            self.views, rows, self.config.batch_size, width, shuffle_seed, *self.share, self.config.set.enlarged,
            self.config.max_error_m,
        )  # fmt: skip


MOST_OF_WINDOW = 2
"""Landmarks kept of a view, over those that a training step looks at."""


LEAST_BATCHES, LEAST_BATCH, LEAST_STEPS = 16, 64, 600
"""Batches that the training views are cut into at least, views of a batch at least, steps in all at least."""


def of_size(config: TrainConfig, n_train: int) -> TrainConfig:
    """Options for so many training views: few are gone through in smaller batches, and more often."""
    batch_size = min(config.batch_size, max(LEAST_BATCH, n_train // LEAST_BATCHES))
    enough = ceil(LEAST_STEPS / ceil(n_train / batch_size))
    if n_train // LEAST_BATCHES >= config.batch_size:
        return config
    return replace(config, batch_size=batch_size, epochs=max(config.epochs, enough))


def learn_set(task: Task, data: SetData | None = None) -> Learnt:
    """A set network from a dataset's labels.

    Whether landmarks are found it learns on the way, from the labels alone. If the dataset's `weights` folder has a
    matchability model of the same width, it starts from that.

    Args:
        task: what to do.
        data: the dataset's views, if they have been described already.

    Raises:
        TableError: no train scene, no labels, or labels of one class only.
        WeightsError: the matchability model is damaged.
    """
    data, options = data or SetData(task), task.config.set
    task = replace(task, config=of_size(task.config, len(data.train_rows)))
    data.config = task.config
    path = task.dataset.root / "weights" / weights_name(MATCHABILITY)
    start = Matchability.load(path).network if options.from_matchability and path.is_file() else None
    statistics = data.statistics if start is None else start.statistics
    network = SetNetwork(statistics, options.width, options.pooled, options.head, options.dropout, options.hidden)
    if start is not None and network.matchability.options == start.options:
        network.matchability.load_state_dict(start.state_dict())
    metrics, history = fit_network(network, data, task)
    logits, labels = predict(network, data)
    counts: dict[str, Any] = class_counts(train=data.views.labels[data.train_rows].cpu().numpy(), val=labels)
    return Learnt(SetModel(network, task.dataset.camera, *fit_platt(logits, labels)), metrics, counts, history)
