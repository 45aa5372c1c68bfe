"""Training scenes of a dataset and of further ones, without PyTorch."""

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
from wheretolook.inputs.channels import ALL_CHANNELS, CHANNELS
from wheretolook.inputs.statistics import FeatureStatistics
from wheretolook.training.config import FittingConfig, SharedConfig
from wheretolook.training.provenance import training_scenes
from wheretolook.training.trained_network import TrainingRange, bin_quantities
from wheretolook.utils.errors import ConfigError, TableError


class Batch(NamedTuple):
    """One process's share of a batch."""

    inputs: tuple[Tensor, ...]  # of the network, tensors with B rows
    labels: Tensor  # (B,) float32
    total: int  # examples in the whole batch, over all processes


class IndexBatches(ABC):
    """Batches of the examples in `rows` (n,), without workers or work for a single example.

    Every process cuts the same batches of `batch_size` and keeps its `share` of each, (its rank, the number of
    processes). Shares differ by one example at most and may be empty, so that all processes take equally many steps.
    With a `shuffle_seed` every pass has its own order, the same in every run; None keeps the order of `rows`. The order
    is drawn by NumPy if `numpy_order`, else by the generator that `collate` is called with.
    """

    numpy_order = False

    def __init__(
        self, rows: Tensor, batch_size: int, shuffle_seed: int | None = None, share: tuple[int, int] = (0, 1)
    ) -> None:
        self.rows = rows
        self.batch_size = batch_size
        self.shuffle_seed = shuffle_seed
        self.share = share
        self._passes = 0

    def __len__(self) -> int:
        return ceil(len(self.rows) / self.batch_size)

    def __iter__(self) -> Iterator[Batch]:
        rows = self.rows
        generator = torch.Generator(rows.device)
        if self.shuffle_seed is not None:
            generator.manual_seed(1_000_003 * self.shuffle_seed + self._passes)
            if self.numpy_order:
                rng = np.random.default_rng([self.shuffle_seed, self._passes])
                rows = rows[torch.from_numpy(rng.permutation(len(rows))).to(rows.device)]
            else:
                rows = rows[torch.randperm(len(rows), generator=generator, device=rows.device)]
            self._passes += 1
        for part in rows.split(self.batch_size):
            yield self.collate(part, generator)

    def share_of(self, whole: Tensor) -> Tensor:
        """Return this process's part of a tensor with a row for each example of a batch."""
        rank, world_size = self.share
        return whole.tensor_split(world_size)[rank]

    @abstractmethod
    def collate(self, rows: Tensor, generator: torch.Generator) -> Batch:
        """Return this process's share of a whole batch of rows, with random numbers of the generator if shuffled."""


@dataclass(frozen=True, eq=False)
class TensorViews:
    """Labelled viewpoints, described by tensors of one device and by arrays."""

    def _tensors(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}

    def to(self, device: torch.device | str) -> Self:
        """Return the same views with their tensors on a device."""
        return replace(self, **{name: value.to(device) for name, value in self._tensors().items()})

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return next(value.device for value in self._tensors().values())

    @property
    def n_bytes(self) -> int:
        """Memory of the tensors."""
        return sum(value.nbytes for value in self._tensors().values())


BLOCK = 4096  # views binned at a time
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class LabelledViews(TensorViews):
    """Labelled viewpoints of some scenes, binned.

    With `CHANNELS` a view takes about 19 kB at 30 x 30 bins: 0.6 GB for 30,000 views, 6.4 GB for 340,000; with
    `ALL_CHANNELS` 51 kB.
    """

    means: Tensor  # (B, C, bins, bins) float32, empty bins zero; see `BinnedViews`
    filled: Tensor  # (B, bins, bins) bool
    labels: Tensor  # (B,) float32, 1 where the viewpoint localizes
    scene: Ints  # (B,) index of each view's scene in the order given
    location: Ints  # (B,) location_id of each view, unique only within its scene
    channels: tuple[str, ...] = CHANNELS  # names of the C channels

    def __len__(self) -> int:
        return len(self.labels)


def fits_on_gpu(device: torch.device | str, n_bytes: int) -> bool:
    """Return whether a device is a GPU with memory for views of so many bytes and for training on them."""
    # views are stored on a GPU with twice the memory they need
    return torch.device(device).type == "cuda" and torch.cuda.mem_get_info(device)[0] > 2 * n_bytes


def load_views(
    dataset: Dataset,
    scenes: Sequence[SceneFolder],
    config: SharedConfig,
    bins: int = 30,
    device: str = "cpu",
    progress: bool = True,
    landmark_channels: bool = False,
) -> LabelledViews:
    """Read the labelled viewpoints of some scenes and bin their landmarks, with `ALL_CHANNELS` or with `CHANNELS`.

    Binning runs on `device`. The views stay there if one device trains and they fit, else they are on the CPU; for
    several, in memory that processes share.

    Raises:
        TableError: a scene has no table or no labelled viewpoint, or its occlusion does not fit.
        MapError: a scene has no landmarks.
        ConfigError: the views do not fit into shared memory.
    """
    tables = [labelled_rows(scene) for scene in scenes]
    total = sum(map(len, tables))
    channels = ALL_CHANNELS if landmark_channels else CHANNELS
    n_bytes = total * bins**2 * (len(channels) * torch.float32.itemsize + torch.bool.itemsize)
    home = device if config.devices == 1 and fits_on_gpu(device, n_bytes) else "cpu"
    means = torch.empty((total, len(channels), bins, bins), device=home)
    filled = torch.empty((total, bins, bins), dtype=torch.bool, device=home)
    if config.devices > 1:
        try:
            means.share_memory_()
            filled.share_memory_()
        except RuntimeError as error:
            fix = "Increase it (in a container, --shm-size), or set train.devices to 1."
            problem = f"the views, {n_bytes / 1e9:.1f} GB, do not fit into shared memory: {error}"
            raise ConfigError(problem, fix=fix) from error
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
    labels, scene_index, location = labels_of(tables, config)
    return LabelledViews(means, filled, labels.to(home), scene_index, location, channels)


def labels_of(tables: Sequence[pd.DataFrame], config: SharedConfig) -> tuple[Tensor, Ints, Ints]:
    """Return labels (B,) float32 of scenes' views, the index of each view's scene, and its location_id, (B,) each."""
    table = pd.concat(tables, ignore_index=True)
    good = is_good(table, config.max_error_m, config.max_error_deg)
    scene = np.repeat(np.arange(len(tables)), [len(part) for part in tables])
    return torch.from_numpy(good.astype(np.float32)), scene, table["location_id"].to_numpy(np.int64)


def labelled_rows(scene: SceneFolder, matches: bool = False) -> pd.DataFrame:
    """Return the labelled viewpoints of a scene, on request with their matches.

    Raises a TableError if there is no table, no labelled viewpoint, or no matches where they are requested.
    """
    table = scene.read_table(matches)
    table = table[table["status"] != UNLABELLED]
    if table.empty:
        raise TableError("no viewpoint has a label", path=scene.table, fix="Run the label command.")
    return table


def validation_views(dataset: Dataset, scene: Ints, location: Ints, config: SharedConfig) -> NDArray[np.bool_]:
    """Return which views (B,) of `training_scenes` are for validation: of val scenes, or else of held-out locations.

    `scene` and `location` (B,) are the index of each view's scene and its location within that.
    """
    if dataset.split("val"):
        return scene >= len(dataset.split("train"))
    return hold_out_locations(scene, location, config.val_fraction, config.seed)


def check_classes(dataset: Dataset, config: SharedConfig, train: NDArray[np.bool_], val: NDArray[np.bool_]) -> None:
    """Raise a TableError if the labels (B,) of the training or the validation views are of one class."""
    to_train = "Label more locations or scenes, loosen max_error_m and max_error_deg, or map more of the scene."
    to_validate = "Label more locations, raise val_fraction, or add a val scene."
    for split, labels, fix in (("training", train, to_train), ("validation", val, to_validate)):
        if labels.all() or not labels.any():
            limits = f"{config.max_error_m:g} m and {config.max_error_deg:g} deg"
            counts = f"{labels.sum()} of {len(labels)} viewpoints localize within {limits}"
            raise TableError(f"the {split} labels are of one class: {counts}", path=dataset.root, fix=fix)


def hold_out_locations(scene: Ints, location: Ints, fraction: float, seed: int) -> NDArray[np.bool_]:
    """Choose locations of every scene for validation, (B,) True where a view is held out; see `validation_views`.

    All views of a location fall on one side, since they share most of their landmarks. The fraction is of each scene's
    locations, rounded up; one location always stays. The same seed and views give the same choice.
    """
    held_out = np.zeros(len(scene), dtype=bool)
    for number in np.unique(scene):
        rows = scene == number
        locations = np.unique(location[rows])
        count = min(ceil(fraction * len(locations)), len(locations) - 1)
        chosen = np.random.default_rng([seed, int(number)]).permutation(locations)[:count]
        held_out[rows] = np.isin(location[rows], chosen)
    return held_out


def balance_classes(positive: NDArray[np.bool_], seed: int) -> Ints:
    """Choose all views of the rarer class and as many of the other at random; return their rows (n,), ascending."""
    classes = [np.flatnonzero(positive), np.flatnonzero(~positive)]
    count = min(map(len, classes))
    rng = np.random.default_rng(seed)
    return np.sort(np.concatenate([rng.permutation(rows)[:count] for rows in classes]))


class BinnedBatches(IndexBatches):
    """Batches of binned views with some of their channels."""

    numpy_order = True

    def __init__(
        self,
        views: LabelledViews,
        rows: Tensor,
        channels: tuple[str, ...],
        batch_size: int,
        shuffle_seed: int | None = None,
        share: tuple[int, int] = (0, 1),
    ) -> None:
        super().__init__(rows.to(views.device), batch_size, shuffle_seed, share)
        self.views = views
        self._channels = torch.tensor([views.channels.index(name) for name in channels], device=views.device)

    def collate(self, rows: Tensor, generator: torch.Generator) -> Batch:
        """Return this process's share of the views in `rows`."""
        share = self.share_of(rows)
        means = self.views.means
        # whole planes of one channel are copied, so that two of five channels cost two fifths
        planes = (share[:, None] * means.shape[1] + self._channels).flatten()
        binned = means.flatten(0, 1).index_select(0, planes).view(len(share), len(self._channels), *means.shape[2:])
        filled = self.views.filled.index_select(0, share)
        return Batch((binned, filled), self.views.labels.index_select(0, share), len(rows))


class ViewsDataModule(LightningDataModule, ABC):
    """Labelled viewpoints of train and val scenes: some to train on, some that decide which epoch was best."""

    config: SharedConfig
    views: Any  # `TensorViews`
    train_rows: Any  # rows of the training views, (n,) int64
    val_rows: Any  # rows of the validation views
    training_range: TrainingRange | None = None  # of the training views

    def setup(self, stage: str | None = None) -> None:
        """Move the views to the device that trains, if they fit."""
        if self.trainer is not None:
            device = self.trainer.strategy.root_device
            if device != self.views.device and fits_on_gpu(device, self.views.n_bytes):
                self.views = self.views.to(device)

    def train_dataloader(self) -> Iterable[Batch]:
        """Return shuffled batches of the training views."""
        return self.batches(self.train_rows, self.config.seed)

    def val_dataloader(self) -> Iterable[Batch]:
        """Return batches of the validation views, in order."""
        return self.batches(self.val_rows)

    @abstractmethod
    def batches(self, rows: Any, shuffle_seed: int | None = None) -> Iterable[Batch]:
        """Return batches of the views in `rows`, shuffled by a seed; without one in order, and larger."""

    def labels(self, rows: Any) -> NDArray[np.bool_]:
        """Return the labels (n,) of what is trained on in the views in `rows`."""
        return (self.views.labels.cpu().numpy() > 0)[rows]

    def split(self, dataset: Dataset) -> NDArray[np.bool_]:
        """Set the rows of training and validation views of a dataset; return which views are held out, (B,)."""
        held_out = validation_views(dataset, self.views.scene, self.views.location, self.config)
        self.train_rows = torch.from_numpy(np.flatnonzero(~held_out))
        self.val_rows = torch.from_numpy(np.flatnonzero(held_out))
        return held_out

    @property
    def share(self) -> tuple[int, int]:
        """Rank of this process, and number of all that train."""
        return (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)


class ViewpointDataModule(ViewsDataModule):
    """The labelled viewpoints of a dataset, binned once for all networks, and split by scene.

    Train scenes are trained on; val scenes, or else held-out locations of the train scenes, decide which epoch was
    best. Batches hold means that are not standardized yet, of `channels`: all that the views have unless set otherwise.

    Raises a TableError if there is no train scene, or the labels of a split are of one class.
    """

    views: LabelledViews

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
        self.config = config
        self.options = options
        views = load_views(dataset, training_scenes(dataset), config, bins, device, progress, landmark_channels)
        self.views = views
        self.channels = views.channels
        self.split(dataset)
        check_classes(dataset, config, self.labels(self.train_rows), self.labels(self.val_rows))
        if options.balance:
            self.train_rows = self.train_rows[balance_classes(self.labels(self.train_rows), config.seed)]
        self.class_weights = class_weights(self.labels(self.train_rows))  # of the negative and the positive class
        self.statistics = FeatureStatistics.of_bins(views.means, views.filled, self.train_rows, views.channels)
        depths = views.means[:, views.channels.index("z")].sum((1, 2), dtype=torch.float64)
        quantities = bin_quantities(depths.cpu().numpy(), views.filled.sum((1, 2)).cpu().numpy())
        self.training_range = TrainingRange.of(quantities[self.train_rows.numpy()])

    def batches(self, rows: Tensor, shuffle_seed: int | None = None) -> BinnedBatches:
        """See `ViewsDataModule.batches`."""
        batch_size = self.options.batch_size * (8 if shuffle_seed is None else 1)
        return BinnedBatches(self.views, rows, self.channels, batch_size, shuffle_seed, self.share)


def class_weights(positive: NDArray[np.bool_]) -> tuple[float, float]:
    """Return weights that give both classes the same total and a mean of 1: n / (2 n_negative), n / (2 n_positive)."""
    total = len(positive)
    n_positive = int(np.count_nonzero(positive))
    return total / (2 * (total - n_positive)), total / (2 * n_positive)
