"""Learning whether a landmark in view will be found by the localizer."""

from __future__ import annotations

from collections.abc import Iterator
from math import ceil, log

import torch
from torch import Tensor

from wheretolook.scorers.matchability.network import MatchabilityNetwork
from wheretolook.training.data import Batch
from wheretolook.training.landmark_views import DISTANCES, LandmarkDataModule
from wheretolook.training.learner import Learnt, Task, class_counts, fit_network, fit_platt, predict
from wheretolook.training.trained_network import TrainedNetwork


class LandmarkBatches:
    """Batches of landmarks (E, len(ATTRIBUTES)) in `rows` (n,), and whether each was found; processes share each batch.

    A `shuffle_seed` of None goes through them in order; shuffled landmarks come from 1 / enlarged to enlarged times as
    far, see `wheretolook.training.landmark_views.LandmarkLoader`.
    """

    def __init__(
        self,
        values: Tensor,
        found: Tensor,
        rows: Tensor,
        batch_size: int,
        shuffle_seed: int | None = None,
        rank: int = 0,
        world_size: int = 1,
        enlarged: float = 1.0,
    ) -> None:
        self.enlarged = enlarged
        self.values = values
        self.found = found
        self.rows = rows.to(values.device)
        self.batch_size = batch_size
        self.shuffle_seed = shuffle_seed
        self.rank = rank
        self.world_size = world_size
        self._pass = 0

    def __len__(self) -> int:
        return ceil(len(self.rows) / self.batch_size)

    def __iter__(self) -> Iterator[Batch]:
        rows = self.rows
        if self.shuffle_seed is not None:
            generator = torch.Generator(rows.device).manual_seed(1_000_003 * self.shuffle_seed + self._pass)
            self._pass += 1  # another order every time
            rows = rows[torch.randperm(len(rows), generator=generator, device=rows.device)]
        for part in rows.split(self.batch_size):
            share = part.tensor_split(self.world_size)[self.rank]
            values = self.values[share].float()
            if self.shuffle_seed is not None and self.enlarged > 1:
                growth = torch.rand(len(part), generator=generator, device=rows.device) * 2 - 1
                growth = growth.tensor_split(self.world_size)[self.rank]
                values[:, DISTANCES] += log(self.enlarged) * growth[:, None]
            yield Batch((values,), self.found[share].float(), len(part))


class MatchabilityData(LandmarkDataModule):
    """Landmarks in view of a dataset's labelled viewpoints, whose matches are stored; a TableError if they are not."""

    def __init__(self, task: Task) -> None:
        super().__init__(task, task.options.landmarks, matches=True)

    @property
    def found(self) -> Tensor:
        """Whether the localizer found each entry's landmark, (E,) bool."""
        assert self.views.found is not None
        return self.views.found

    def entries(self, rows: Tensor) -> Tensor:
        """Entries (n,) of the landmarks of some views."""
        chosen = torch.zeros(len(self.views), dtype=torch.bool)
        chosen[rows] = True
        return torch.nonzero(chosen.repeat_interleave(self.views.starts.cpu().diff()))[:, 0]

    def batches(self, rows: Tensor, shuffle_seed: int | None = None) -> LandmarkBatches:
        """Batches of the landmarks of the views in `rows`, see `ViewsDataModule.batches`."""
        size = self.options.batch_size * self.options.landmarks * (8 if shuffle_seed is None else 1)
        entries = self.entries(rows)
        enlarged = self.options.enlarged
        return LandmarkBatches(self.views.values, self.found, entries, size, shuffle_seed, *self.share, enlarged)


def learn_matchability(task: Task) -> Learnt:
    """The probability of being found, from the matches that are stored with a dataset's labels.

    Raises a TableError if there is no train scene, no labels, or no stored matches.
    """
    data = MatchabilityData(task)
    network = MatchabilityNetwork(data.statistics, task.options.width, task.options.hidden)
    metrics, history = fit_network(network, data, task)
    logits, found = predict(network, data)
    counts = class_counts(train=data.found.cpu()[data.entries(data.train_rows)].numpy(), val=found)
    model = TrainedNetwork(task.method, network, task.camera, *fit_platt(logits, found), data.training_range)
    return Learnt(model, metrics, counts, history)
