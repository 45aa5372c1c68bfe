"""Learning whether a landmark in view will be found by the localizer."""

from __future__ import annotations

from collections.abc import Iterator
from math import ceil
from typing import ClassVar

import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor, nn

from wheretolook.learning.config import MATCHABILITY
from wheretolook.learning.data import Batch, has_room, training_scenes, validation_views
from wheretolook.learning.fit import home_device
from wheretolook.learning.landmark_model import LandmarkModel
from wheretolook.learning.landmark_views import AttributeStatistics, load_landmark_views
from wheretolook.learning.learner import Learnt, Task, class_counts, fit_network, predict
from wheretolook.learning.platt import fit_platt
from wheretolook.learning.set_network import MatchabilityNetwork


class Matchability(LandmarkModel):
    """The probability that a landmark in view is found, from how it was mapped and where it is seen from."""

    kind: ClassVar[str] = MATCHABILITY
    network_class: ClassVar[type[nn.Module]] = MatchabilityNetwork

    def log_odds(self, values: Tensor) -> Tensor:
        """Calibrated log-odds (E,) of landmarks (E, len(ATTRIBUTES)) on the network's device."""
        with torch.inference_mode():
            logits: Tensor = self.network(values)
            return self.scale * logits + self.offset


class LandmarkBatches:
    """Batches of landmarks in view, and whether each was found.

    Args:
        values: (E, len(ATTRIBUTES)).
        found: (E,) bool.
        rows: which of them, (n,).
        batch_size: landmarks a batch.
        shuffle_seed: seed of their order; None goes through them in order.
    """

    def __init__(
        self, values: Tensor, found: Tensor, rows: Tensor, batch_size: int, shuffle_seed: int | None = None
    ) -> None:
        self.values, self.found, self.rows, self.batch_size = values, found, rows.to(values.device), batch_size
        self.shuffle_seed, self._pass = shuffle_seed, 0

    def __len__(self) -> int:
        return ceil(len(self.rows) / self.batch_size)

    def __iter__(self) -> Iterator[Batch]:
        rows = self.rows
        if self.shuffle_seed is not None:
            generator = torch.Generator(rows.device).manual_seed(1_000_003 * self.shuffle_seed + self._pass)
            self._pass += 1  # another order every time
            rows = rows[torch.randperm(len(rows), generator=generator, device=rows.device)]
        for part in rows.split(self.batch_size):
            yield Batch((self.values[part].float(),), self.found[part].float(), len(part))


class MatchabilityData(LightningDataModule):
    """Landmarks in view of a dataset's labelled viewpoints, whose matches are stored.

    Args:
        task: what to learn from.

    Attributes:
        train, val: batches.
        statistics: over the training landmarks.

    Raises:
        TableError: no train scene, no labels, or no stored matches.
    """

    def __init__(self, task: Task) -> None:
        super().__init__()
        config, dataset, device = task.config, task.dataset, home_device(task.config)
        most = config.matchability.landmarks
        views = load_landmark_views(
            dataset, training_scenes(dataset), config, most, device, task.progress, matches=True
        )
        held_out = torch.from_numpy(validation_views(dataset, views.scene, views.location, config))
        views = views.to(device) if has_room(device, views.n_bytes) else views
        assert views.found is not None
        sides = held_out.repeat_interleave(views.starts.cpu().diff())
        rows = [torch.nonzero(side)[:, 0] for side in (~sides, sides)]
        self.statistics = AttributeStatistics.of(views.values[rows[0].to(views.values.device)].float())
        batch = config.batch_size * most
        self.train = LandmarkBatches(views.values, views.found, rows[0], batch, config.seed)
        self.val = LandmarkBatches(views.values, views.found, rows[1], 8 * batch)

    def train_dataloader(self) -> LandmarkBatches:
        """Shuffled landmarks of the training views."""
        return self.train

    def val_dataloader(self) -> LandmarkBatches:
        """Landmarks of the validation views, in order."""
        return self.val


def learn_matchability(task: Task) -> Learnt:
    """The probability of being found, from the matches that are stored with a dataset's labels.

    Raises:
        TableError: no train scene, no labels, or no stored matches.
    """
    data = MatchabilityData(task)
    options = task.config.matchability
    network = MatchabilityNetwork(data.statistics, options.width, options.hidden)
    metrics, history = fit_network(network, data, task)
    logits, found = predict(network, data)
    counts = class_counts(train=data.train.found[data.train.rows].cpu().numpy(), val=found)
    return Learnt(Matchability(network, task.dataset.camera, *fit_platt(logits, found)), metrics, counts, history)
