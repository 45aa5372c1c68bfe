"""Labelled viewpoints as tensors: binned once, shared by every network that trains on them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np
import pandas as pd
import torch
from lightning.pytorch import LightningDataModule
from numpy.typing import NDArray
from torch import Tensor
from tqdm.auto import tqdm

from wheretolook.dataset import Dataset, SceneFolder
from wheretolook.errors import TableError
from wheretolook.features import CHANNELS
from wheretolook.learning.config import TrainConfig
from wheretolook.learning.network import InputStatistics
from wheretolook.table import UNLABELLED, is_good, poses

BLOCK = 4096
"""Views binned at a time."""

Batch = tuple[Tensor, Tensor, Tensor]
"""Means (B, C, bins, bins) float32, filled (B, bins, bins) bool and labels (B,) float32."""


@dataclass(frozen=True, eq=False)
class LabelledViews:
    """Labelled viewpoints of some scenes, binned, with all of `CHANNELS`.

    A view takes about 19 kB at 30 x 30 bins: 0.6 GB for 30,000 views, 6.4 GB for 340,000.

    Attributes:
        means: (B, len(CHANNELS), bins, bins) float32, empty bins zero.
        filled: (B, bins, bins) bool.
        labels: (B,) float32, 1 where the viewpoint localizes.
        scene: (B,) int64, number of each view's scene in the order given.
        location: (B,) int64, location_id of each view, unique only within its scene.
    """

    means: Tensor
    filled: Tensor
    labels: Tensor
    scene: NDArray[np.int64]
    location: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.labels)

    def to(self, device: torch.device | str) -> LabelledViews:
        """The same views with their tensors on a device."""
        return LabelledViews(
            self.means.to(device), self.filled.to(device), self.labels.to(device), self.scene, self.location
        )

    @property
    def n_bytes(self) -> int:
        """Memory the tensors take."""
        return sum(tensor.nbytes for tensor in (self.means, self.filled, self.labels))


def load_views(
    dataset: Dataset, scenes: Sequence[SceneFolder], config: TrainConfig, device: str = "cpu", progress: bool = True
) -> LabelledViews:
    """Read the labelled viewpoints of some scenes and bin their landmarks.

    Args:
        dataset: gives the camera.
        scenes: scenes of the dataset.
        config: number of bins and error limits of a positive label.
        device: where the binning runs, "cpu" or a CUDA device. The views come back on the CPU.
        progress: show a progress bar.

    Raises:
        TableError: a scene has no table or no labelled viewpoint, or its occlusion does not fit.
        MapError: a scene has no landmarks.
    """
    tables: list[pd.DataFrame] = []
    for scene in scenes:
        table = scene.read_table()
        table = table[table["status"] != UNLABELLED]
        if table.empty:
            raise TableError("no viewpoint has a label", path=scene.table, fix="Run the label stage.")
        tables.append(table)
    total, bins = sum(map(len, tables)), config.bins
    means = torch.empty((total, len(CHANNELS), bins, bins))
    filled = torch.empty((total, bins, bins), dtype=torch.bool)
    start = 0
    with tqdm(total=total, desc="bin views", unit="view", disable=not progress) as bar:
        for scene, table in zip(scenes, tables, strict=True):
            localization_map = scene.localization_map(dataset.camera, device)
            for begin in range(0, len(table), BLOCK):
                binned = localization_map.bin_views(poses(table.iloc[begin : begin + BLOCK]), bins=bins)
                rows = slice(start, start + len(binned))
                means[rows] = torch.from_numpy(binned.means)
                filled[rows] = torch.from_numpy(binned.counts > 0)
                start += len(binned)
                bar.update(len(binned))
    good = [is_good(table, config.max_error_m, config.max_error_deg) for table in tables]
    return LabelledViews(
        means,
        filled,
        torch.from_numpy(np.concatenate(good).astype(np.float32)),
        np.repeat(np.arange(len(tables)), [len(table) for table in tables]),
        np.concatenate([table["location_id"].to_numpy(np.int64) for table in tables]),
    )


def hold_out_locations(
    scene: NDArray[np.int64], location: NDArray[np.int64], fraction: float, seed: int
) -> NDArray[np.bool_]:
    """Choose locations of every scene for validation.

    All views of a location fall on one side: views that share a location share most of their landmarks.

    Args:
        scene: (B,) number of each view's scene.
        location: (B,) location of each view within its scene.
        fraction: share of each scene's locations, rounded up; one location always stays.
        seed: the same seed and views give the same choice.

    Returns:
        (B,) True where the view is held out.
    """
    held_out = np.zeros(len(scene), dtype=bool)
    for number in np.unique(scene):
        rows = scene == number
        locations = np.unique(location[rows])
        count = min(ceil(fraction * len(locations)), len(locations) - 1)
        chosen = np.random.default_rng([seed, int(number)]).permutation(locations)[:count]
        held_out[rows] = np.isin(location[rows], chosen)
    return held_out


class BatchLoader:
    """Iterates over batches cut from tensors by index: no worker, no per-sample work, no copy of the views.

    Args:
        views: the views.
        rows: which of them, (n,) int64.
        batch_size: views a batch; the last one may be smaller.
        shuffle_seed: every pass has its own order, the same in every run; None keeps the order of `rows`.
    """

    def __init__(self, views: LabelledViews, rows: Tensor, batch_size: int, shuffle_seed: int | None = None) -> None:
        self.views, self.rows, self.batch_size, self.shuffle_seed = views, rows, batch_size, shuffle_seed
        self._passes = 0

    def __len__(self) -> int:
        return ceil(len(self.rows) / self.batch_size)

    def __iter__(self) -> Iterator[Batch]:
        rows = self.rows
        if self.shuffle_seed is not None:
            order = np.random.default_rng([self.shuffle_seed, self._passes]).permutation(len(rows))
            rows = rows[torch.from_numpy(order)]
            self._passes += 1
        for batch in rows.to(self.views.labels.device).split(self.batch_size):
            yield self.views.means[batch], self.views.filled[batch], self.views.labels[batch]


class ViewpointDataModule(LightningDataModule):
    """The labelled viewpoints of a dataset, split by scene.

    Batches hold all of `CHANNELS`, unstandardized: the network picks its own and standardizes them. So the views are
    binned once, whichever networks train on them.

    Args:
        dataset: its train scenes are learnt from; its val scenes, or else held-out locations of the train scenes, tell
            which epoch was best.
        config: batch size, bins, label limits, share held out, seed.
        device: where the binning runs.
        progress: show progress bars.

    Attributes (after `setup`):
        views: the views of train and val scenes.
        train_rows: rows of `views` to learn from, (n,) int64.
        val_rows: rows of `views` for validation.
        statistics: of all channels over the training views.
        class_weights: weights of the negative and the positive class, from the training labels.
    """

    views: LabelledViews
    train_rows: Tensor
    val_rows: Tensor
    statistics: InputStatistics
    class_weights: tuple[float, float]

    def __init__(self, dataset: Dataset, config: TrainConfig, device: str = "cpu", progress: bool = True) -> None:
        super().__init__()
        self.dataset, self.config, self.device, self.progress = dataset, config, device, progress

    def setup(self, stage: str | None = None) -> None:
        """Read, bin and split the views, once.

        Raises:
            TableError: there is no train scene, or the labels of a split are of one class.
        """
        if hasattr(self, "views"):
            return
        train, val = self.dataset.split("train"), self.dataset.split("val")
        if not train:
            raise TableError(
                "the dataset has no train scene", path=self.dataset.root, fix="Make one, or train on another dataset."
            )
        views = load_views(self.dataset, [*train, *val], self.config, self.device, self.progress)
        if val:
            held_out = views.scene >= len(train)
        else:
            held_out = hold_out_locations(views.scene, views.location, self.config.val_fraction, self.config.seed)
        self.train_rows, self.val_rows = (torch.from_numpy(np.flatnonzero(side)) for side in (~held_out, held_out))
        for name, rows in (("training", self.train_rows), ("validation", self.val_rows)):
            self._check_classes(name, views.labels[rows])
        self.class_weights = class_weights(views.labels[self.train_rows])
        self.statistics = InputStatistics.of(views.means, views.filled, self.train_rows)
        self.views = views

    def move_to(self, device: torch.device) -> None:
        """Keep the views on a device; for a GPU with room for them, no batch has to travel then."""
        self.views = self.views.to(device)

    def train_dataloader(self) -> BatchLoader:
        """Shuffled batches of the training views."""
        return BatchLoader(self.views, self.train_rows, self.config.batch_size, shuffle_seed=self.config.seed)

    def val_dataloader(self) -> BatchLoader:
        """Batches of the validation views, in order."""
        return BatchLoader(self.views, self.val_rows, 8 * self.config.batch_size)

    def _check_classes(self, split: str, labels: Tensor) -> None:
        positives = int(labels.sum())
        if 0 < positives < len(labels):
            return
        limits = f"{self.config.max_error_m:g} m and {self.config.max_error_deg:g} deg"
        raise TableError(
            f"the {split} labels are of one class: {positives} of {len(labels)} viewpoints localize within {limits}",
            path=self.dataset.root,
            fix="Label more locations or scenes, loosen max_error_m and max_error_deg, or map more of the scene."
            if split == "training"
            else "Label more locations, raise val_fraction, or add a val scene.",
        )


def class_weights(labels: Tensor) -> tuple[float, float]:
    """Weights that give both classes the same total and a mean of 1: n / (2 n_negative) and n / (2 n_positive)."""
    total, positives = len(labels), float(labels.sum())
    return total / (2 * (total - positives)), total / (2 * positives)
