"""Labelled viewpoints as tensors: binned once, shared by every network that trains on them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Any, NamedTuple, Self

import numpy as np
import pandas as pd
import torch
from lightning.pytorch import LightningDataModule
from numpy.typing import NDArray
from torch import Tensor
from tqdm.auto import tqdm

from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.viewpoint_table import UNLABELLED, is_good, poses
from wheretolook.inputs.bins import InputStatistics
from wheretolook.inputs.channels import ALL_CHANNELS, CHANNELS
from wheretolook.training.config import FittingConfig, SharedConfig
from wheretolook.training.scenes import training_scenes
from wheretolook.training.training_range import TrainingRange, bin_quantities
from wheretolook.utils.errors import ConfigError, TableError

BLOCK = 4096  # views binned at a time
ROOM = 2  # views are kept on a GPU that has this many times the memory they need


class Batch(NamedTuple):
    """One process's share of a batch."""

    # what the network takes, tensors with B rows; of binned views means (B, C, bins, bins) and filled (B, bins, bins)
    inputs: tuple[Tensor, ...]
    labels: Tensor  # (B,) float32
    total: int  # views in the whole batch, over all processes


@dataclass(frozen=True, eq=False)
class TensorViews:
    """Labelled viewpoints, known by tensors of one device and by arrays."""

    def _tensors(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}

    def to(self, device: torch.device | str) -> Self:
        """The same views with their tensors on a device."""
        return replace(self, **{name: value.to(device) for name, value in self._tensors().items()})

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return next(value.device for value in self._tensors().values())

    @property
    def n_bytes(self) -> int:
        """Memory the tensors take."""
        return sum(value.nbytes for value in self._tensors().values())


@dataclass(frozen=True, eq=False)
class LabelledViews(TensorViews):
    """Labelled viewpoints of some scenes, binned.

    With `CHANNELS` a view takes about 19 kB at 30 x 30 bins: 0.6 GB for 30,000 views, 6.4 GB for 340,000; with
    `ALL_CHANNELS` 51 kB.
    """

    means: Tensor  # (B, C, bins, bins) float32, empty bins zero; see `BinnedViews`
    filled: Tensor  # (B, bins, bins) bool
    labels: Tensor  # (B,) float32, 1 where the viewpoint localizes
    scene: NDArray[np.int64]  # (B,) int64, number of each view's scene in the order given
    location: NDArray[np.int64]  # (B,) int64, location_id of each view, unique only within its scene
    channels: tuple[str, ...] = CHANNELS  # names of the C channels

    def __len__(self) -> int:
        return len(self.labels)


def has_room(device: torch.device | str, n_bytes: int) -> bool:
    """Whether a device is a GPU with room for views of so many bytes, and for training on them."""
    return torch.device(device).type == "cuda" and torch.cuda.mem_get_info(device)[0] > ROOM * n_bytes


def load_views(
    dataset: Dataset,
    scenes: Sequence[SceneFolder],
    config: SharedConfig,
    bins: int = 30,
    device: str = "cpu",
    progress: bool = True,
    landmark_channels: bool = False,
) -> LabelledViews:
    """Read the labelled viewpoints of some scenes and bin their landmarks, by `ALL_CHANNELS` or by `CHANNELS` alone.

    The binning runs on `device`, "cpu" or a CUDA device. The views come back on it if one device trains and it has room
    for them, else on the CPU; for several, in memory that processes can share.

    Raises a TableError if a scene has no table or no labelled viewpoint, or its occlusion does not fit; a MapError if
    it has no landmarks; a ConfigError if the views do not fit into shared memory.
    """
    tables = [labelled_rows(scene) for scene in scenes]
    total = sum(map(len, tables))
    channels = ALL_CHANNELS if landmark_channels else CHANNELS
    n_bytes = total * bins**2 * (len(channels) * torch.float32.itemsize + torch.bool.itemsize)
    home = device if config.devices == 1 and has_room(device, n_bytes) else "cpu"
    means = torch.empty((total, len(channels), bins, bins), device=home)
    filled = torch.empty((total, bins, bins), dtype=torch.bool, device=home)
    if config.devices > 1:
        _share(means, filled)
    start = 0
    with tqdm(total=total, desc="bin views", unit="view", disable=not progress) as bar:
        for scene, table in zip(scenes, tables, strict=True):
            localization_map = scene.localization_map(dataset.camera, device)
            for begin in range(0, len(table), BLOCK):
                block = poses(table.iloc[begin : begin + BLOCK])
                binned = localization_map.bin_views(block, bins, landmark_channels)
                rows = slice(start, start + len(binned))
                means[rows] = torch.from_numpy(binned.means)
                filled[rows] = torch.from_numpy(binned.counts > 0)
                start += len(binned)
                bar.update(len(binned))
    labels, scene_of, location_of = labels_of(tables, config)
    return LabelledViews(means, filled, labels.to(home), scene_of, location_of, channels)


def labels_of(
    tables: Sequence[pd.DataFrame], config: SharedConfig
) -> tuple[Tensor, NDArray[np.int64], NDArray[np.int64]]:
    """Labels (B,) float32 of scenes' views, the number of each view's scene, and its location_id, (B,) int64 each."""
    good = [is_good(table, config.max_error_m, config.max_error_deg) for table in tables]
    location = np.concatenate([table["location_id"].to_numpy(np.int64) for table in tables])
    scene = np.repeat(np.arange(len(tables)), [len(table) for table in tables])
    return torch.from_numpy(np.concatenate(good).astype(np.float32)), scene, location


def labelled_rows(scene: SceneFolder, matches: bool = False) -> pd.DataFrame:
    """The labelled viewpoints of a scene, on request with their matches; see `wheretolook.dataset.viewpoint_table.read_table`.

    Raises a TableError if there is no table, no labelled viewpoint, or no matches where they are asked for.
    """
    table = scene.read_table(matches)
    table = table[table["status"] != UNLABELLED]
    if table.empty:
        raise TableError("no viewpoint has a label", path=scene.table, fix="Run the label stage.")
    return table


def _share(*tensors: Tensor) -> None:
    """Move tensors into memory that other processes can map."""
    try:
        for tensor in tensors:
            tensor.share_memory_()
    except RuntimeError as error:
        size = sum(tensor.nbytes for tensor in tensors) / 1e9
        fix = "Give it more room (in a container, --shm-size), or set train.devices to 1."
        raise ConfigError(f"the views, {size:.1f} GB, do not fit into shared memory: {error}", fix=fix) from error


def validation_views(
    dataset: Dataset, scene: NDArray[np.int64], location: NDArray[np.int64], config: SharedConfig
) -> NDArray[np.bool_]:
    """Which views (B,) of `training_scenes` are for validation: those of val scenes, or else of held-out locations.

    Of each view `scene` tells the number of its scene and `location` its location within that, (B,) each.
    """
    if dataset.split("val"):
        return scene >= len(dataset.split("train"))
    return hold_out_locations(scene, location, config.val_fraction, config.seed)


def check_classes(dataset: Dataset, config: SharedConfig, train: NDArray[np.bool_], val: NDArray[np.bool_]) -> None:
    """Raise a TableError if the labels (B,) of the views for training or of those for validation are of one class."""
    to_train = "Label more locations or scenes, loosen max_error_m and max_error_deg, or map more of the scene."
    to_validate = "Label more locations, raise val_fraction, or add a val scene."
    for split, labels, fix in (("training", train, to_train), ("validation", val, to_validate)):
        if labels.all() or not labels.any():
            limits = f"{config.max_error_m:g} m and {config.max_error_deg:g} deg"
            found = f"{labels.sum()} of {len(labels)} viewpoints localize within {limits}"
            raise TableError(f"the {split} labels are of one class: {found}", path=dataset.root, fix=fix)


def hold_out_locations(
    scene: NDArray[np.int64], location: NDArray[np.int64], fraction: float, seed: int
) -> NDArray[np.bool_]:
    """Choose locations of every scene for validation, (B,) True where a view is held out; see `validation_views`.

    All views of a location fall on one side: views that share a location share most of their landmarks. The fraction is
    of each scene's locations, rounded up; one location always stays. The same seed and views give the same choice.
    """
    held_out = np.zeros(len(scene), dtype=bool)
    for number in np.unique(scene):
        rows = scene == number
        locations = np.unique(location[rows])
        count = min(ceil(fraction * len(locations)), len(locations) - 1)
        chosen = np.random.default_rng([seed, int(number)]).permutation(locations)[:count]
        held_out[rows] = np.isin(location[rows], chosen)
    return held_out


def balance_classes(labels: Tensor, seed: int) -> Tensor:
    """Choose equally many views of both classes: all of the rarer one, and as many of the other at random, by the seed.

    Returns the rows of labels (B,), 0 or 1, that are chosen: (n,) int64, in ascending order, on the CPU.
    """
    positive = labels.cpu().numpy() > 0
    classes = [np.flatnonzero(positive), np.flatnonzero(~positive)]
    count = min(map(len, classes))
    rng = np.random.default_rng(seed)
    return torch.from_numpy(np.sort(np.concatenate([rng.permutation(rows)[:count] for rows in classes])))


class BatchLoader:
    """Batches of the views in `rows` (n,), cut from tensors by index: no worker, nothing done for a single view.

    With several processes, every one cuts the same batches of `batch_size` and keeps its share of each. Shares differ
    by one view at most and can be empty, so that all processes take equally many steps. With a `shuffle_seed` every
    pass has its own order, the same in every run; None keeps the order of `rows`.
    """

    def __init__(
        self,
        views: LabelledViews,
        rows: Tensor,
        batch_size: int,
        shuffle_seed: int | None = None,
        channels: tuple[str, ...] = CHANNELS,
        rank: int = 0,
        world_size: int = 1,
    ) -> None:
        self.views = views
        self.rows = rows
        self.batch_size = batch_size
        self.shuffle_seed = shuffle_seed
        self.rank = rank
        self.world_size = world_size
        self._channels = torch.tensor([views.channels.index(name) for name in channels])
        self._passes = 0

    def __len__(self) -> int:
        return ceil(len(self.rows) / self.batch_size)

    def __iter__(self) -> Iterator[Batch]:
        rows = self.rows
        if self.shuffle_seed is not None:
            order = np.random.default_rng([self.shuffle_seed, self._passes]).permutation(len(rows))
            rows = rows[torch.from_numpy(order)]
            self._passes += 1
        means = self.views.means
        filled = self.views.filled
        labels = self.views.labels
        # whole planes of one channel are copied: a variant of two channels does not pay for five
        planes = means.flatten(0, 1)
        shape = (len(self._channels), *means.shape[2:])
        of_rows = (rows[:, None] * means.shape[1] + self._channels).to(means.device)
        rows = rows.to(means.device)
        for batch, wanted in zip(rows.split(self.batch_size), of_rows.split(self.batch_size), strict=True):
            share, planes_of_share = (part.tensor_split(self.world_size)[self.rank] for part in (batch, wanted))
            binned = planes.index_select(0, planes_of_share.flatten()).view(len(share), *shape)
            yield Batch((binned, filled.index_select(0, share)), labels.index_select(0, share), len(batch))


class ViewsDataModule(LightningDataModule, ABC):
    """Labelled viewpoints of train and val scenes, some to learn from and some to tell which epoch was best."""

    config: SharedConfig
    views: Any  # `TensorViews`
    train_rows: Any  # rows of the views to learn from, (n,) int64
    val_rows: Any  # rows of the views for validation

    def setup(self, stage: str | None = None) -> None:
        """Bring the views to the device that trains, if it has room for them."""
        if self.trainer is not None:
            device = self.trainer.strategy.root_device
            if device != self.views.device and has_room(device, self.views.n_bytes):
                self.views = self.views.to(device)

    def train_dataloader(self) -> Iterable[Batch]:
        """Shuffled batches of the training views."""
        return self.batches(self.train_rows, self.config.seed)

    def val_dataloader(self) -> Iterable[Batch]:
        """Batches of the validation views, in order."""
        return self.batches(self.val_rows)

    @abstractmethod
    def batches(self, rows: Any, shuffle_seed: int | None = None) -> Iterable[Batch]:
        """Batches of the views in `rows`, shuffled by a seed; without one in order, and larger: nothing is learnt."""

    @property
    def share(self) -> tuple[int, int]:
        """Number of this process, and number of all that train."""
        return (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)


class ViewpointDataModule(ViewsDataModule):
    """The labelled viewpoints of a dataset, binned and split by scene.

    Batches hold means that are not standardized yet: the network does that. So the views are binned once, whichever
    networks train on them; see `load_views` for where. The train scenes are learnt from; val scenes, or else held-out
    locations of the train scenes, tell which epoch was best. Batches hold all `channels` that the views have unless
    these are set otherwise; those of what landmarks are like take about three times the memory.
    """

    views: LabelledViews
    train_rows: Tensor
    val_rows: Tensor
    training_range: TrainingRange  # of the depths of the training views, known after `setup`
    statistics: InputStatistics  # of all channels over the training views, known after `setup`
    class_weights: tuple[float, float]  # of the negative and the positive class, by the training labels after `setup`

    def __init__(
        self,
        dataset: Dataset,
        config: SharedConfig,
        options: FittingConfig,
        bins: int = 30,
        device: str = "cpu",
        progress: bool = True,
        landmark_channels: bool = False,
    ) -> None:
        super().__init__()
        self.dataset = dataset
        self.config = config
        self.options = options
        self._how = bins, device, progress, landmark_channels
        self.channels: tuple[str, ...] = ALL_CHANNELS if landmark_channels else CHANNELS

    def setup(self, stage: str | None = None) -> None:
        """Read, bin and split the views, once; in a process that trains, bring them to its device.

        Raises a TableError if there is no train scene, or the labels of a split are of one class.
        """
        if not hasattr(self, "views"):
            views = load_views(self.dataset, training_scenes(self.dataset), self.config, *self._how)
            self.use(views, validation_views(self.dataset, views.scene, views.location, self.config))
        super().setup(stage)

    def use(self, views: LabelledViews, held_out: NDArray[np.bool_]) -> None:
        """Train on these views instead of those of the dataset, without those held out (B,).

        Raises a TableError if the labels of a split are of one class.
        """
        self.train_rows, self.val_rows = (torch.from_numpy(np.flatnonzero(side)) for side in (~held_out, held_out))
        labels = views.labels.cpu()
        check_classes(self.dataset, self.config, *((labels[r] > 0).numpy() for r in (self.train_rows, self.val_rows)))
        if self.options.balance:
            self.train_rows = self.train_rows[balance_classes(labels[self.train_rows], self.config.seed)]
        self.class_weights = class_weights(labels[self.train_rows])
        self.statistics = InputStatistics.of(views.means, views.filled, self.train_rows, views.channels)
        depths = views.means[:, views.channels.index("z")].sum((1, 2), dtype=torch.float64)
        quantities = bin_quantities(depths.cpu().numpy(), views.filled.sum((1, 2)).cpu().numpy())
        self.training_range = TrainingRange.of(quantities[self.train_rows.numpy()])
        self.views = views

    def batches(self, rows: Tensor, shuffle_seed: int | None = None) -> BatchLoader:
        """See `ViewsDataModule.batches`."""
        batch_size = self.options.batch_size * (8 if shuffle_seed is None else 1)
        return BatchLoader(self.views, rows, batch_size, shuffle_seed, self.channels, *self.share)


def class_weights(labels: Tensor) -> tuple[float, float]:
    """Weights that give both classes the same total and a mean of 1: n / (2 n_negative) and n / (2 n_positive)."""
    total = len(labels)
    positives = float(labels.sum())
    return total / (2 * (total - positives)), total / (2 * positives)
