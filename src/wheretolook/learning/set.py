"""Learning to score views by the set of landmarks they see."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor, nn

from wheretolook.attributes import ViewLandmarks
from wheretolook.learning.config import MATCHABILITY, SET, weights_name
from wheretolook.learning.data import check_classes, has_room, training_scenes, validation_views
from wheretolook.learning.fit import home_device
from wheretolook.learning.landmark_model import LandmarkModel
from wheretolook.learning.landmark_views import AttributeStatistics, LandmarkLoader, load_landmark_views
from wheretolook.learning.learner import Learnt, Task, class_counts, fit_network, predict
from wheretolook.learning.matchability import Matchability
from wheretolook.learning.platt import fit_platt
from wheretolook.learning.set_network import SetNetwork


class SetModel(LandmarkModel):
    """The probability that a view localizes, from the set of landmarks it sees."""

    kind: ClassVar[str] = SET
    network_class: ClassVar[type[nn.Module]] = SetNetwork

    def log_odds(self, landmarks: ViewLandmarks, visible: Tensor, axis_height: Tensor) -> Tensor:
        """Calibrated log-odds (B,) float64 of views by `SetNetwork.score`, all on the network's device."""
        with torch.inference_mode():
            logits: Tensor = self.network.score(landmarks, visible, axis_height)
            return self.scale * logits.double() + self.offset


class SetData(LightningDataModule):
    """The labelled viewpoints of a dataset, by the landmarks they see.

    Args:
        task: what to learn from.

    Attributes:
        views: of train and val scenes.
        train_rows, val_rows: rows of `views`, (n,).
        statistics: over the training views' landmarks.

    Raises:
        TableError: no train scene, no labels, or labels of one class only.
    """

    def __init__(self, task: Task) -> None:
        super().__init__()
        self.config, dataset, device = task.config, task.dataset, home_device(task.config)
        most = MOST_OF_WINDOW * self.config.set.landmarks
        views = load_landmark_views(dataset, training_scenes(dataset), self.config, most, device, task.progress)
        held_out = torch.from_numpy(validation_views(dataset, views.scene, views.location, self.config))
        self.train_rows, self.val_rows = (torch.nonzero(side)[:, 0] for side in (~held_out, held_out))
        for name, rows in (("training", self.train_rows), ("validation", self.val_rows)):
            check_classes(name, views.labels[rows].numpy() > 0, dataset, self.config)
        of_train = (~held_out).repeat_interleave(views.starts.diff())
        self.statistics = AttributeStatistics.of(views.values[of_train].float())
        self.views = views.to(device) if has_room(device, views.n_bytes) else views

    def train_dataloader(self) -> LandmarkLoader:
        """Shuffled views, another sample of each one's landmarks every time."""
        options = self.config
        return LandmarkLoader(self.views, self.train_rows, options.batch_size, options.set.landmarks, options.seed)

    def val_dataloader(self) -> LandmarkLoader:
        """Views in order, with the same landmarks every time."""
        return LandmarkLoader(
            self.views, self.val_rows, self.config.batch_size, MOST_OF_WINDOW * self.config.set.landmarks
        )


MOST_OF_WINDOW = 2
"""Landmarks kept of a view, over those that a training step looks at."""


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
