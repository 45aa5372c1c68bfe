"""Tokens of locations, the input of the sphere network, and batches of their labelled viewpoints."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence
from tqdm.auto import tqdm

from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.viewpoint_table import poses
from wheretolook.geometry.poses import Float, split_poses
from wheretolook.inputs.localization_map import LocalizationMap, shared_locations
from wheretolook.training.config import SharedConfig
from wheretolook.training.data import Batch, IndexBatches, TensorViews, ViewsDataModule, labelled_rows, labels_of
from wheretolook.utils.errors import MapError
from wheretolook_paper.scorers.sphere import SphereConfig

_VECTORS = tuple(f"{name}_{axis}" for name in ("offset", "towards", "looks") for axis in "xyz")
FEATURES = (*_VECTORS, "log_distance", "log_landmarks", "is_landmark", "is_camera")
"""Features of a token: the offset from the location, world axes, in units of `OFFSET_M`, and its unit direction; the viewing
direction of a camera; log(1 + distance in metres); log(1 + landmarks with a free line of sight from the location); and
what it is. The first token of a location is neither: it stands for all landmarks and holds their number."""

TOWARDS = slice(3, 6)  # the features that are the unit direction
TURNING = 9  # the first features, three vectors, which turn with the world
OFFSET_M = 4.0  # unit of offsets: ActLoc crops the world at so many metres
BLOCK = 256  # locations whose lines of sight are computed at a time


class LocationDescriber:
    """Describes locations to a network: their landmarks with a free line of sight, and the mapping cameras.

    If there are more landmarks or cameras than configured, evenly spread ones are used, in the order of their ids.
    Raises a MapError if the map has no mapping cameras.
    """

    def __init__(self, localization_map: LocalizationMap, config: SphereConfig) -> None:
        if localization_map.mapping_poses is None:
            fix = "Run the map stage again, copy the release again, or use `LocalizationMap.from_colmap`."
            raise MapError("the poses of the map's images are unknown", fix=fix)
        self.localization_map = localization_map
        self.config = config
        rotations, self._centers = split_poses(_spread(localization_map.mapping_poses, config.cameras))
        self._looks = rotations[:, 2]

    def describe(self, locations: Float) -> Iterator[Tensor]:
        """Yield the tokens (T, len(FEATURES)) float32, on the CPU, of each location (L, 3) m; T differs, but is not 0."""
        points = self.localization_map.landmarks.points
        for begin in range(0, len(locations), BLOCK):
            block = np.asarray(locations, dtype=np.float64)[begin : begin + BLOCK]
            for location, free in zip(block, self.localization_map.occlusion.unoccluded(block, points), strict=True):
                yield self._tokens(location, points[free])

    def _tokens(self, location: Float, points: Float) -> Tensor:
        seen = _spread(points, self.config.points)
        offsets = np.concatenate([np.zeros((1, 3)), seen - location, self._centers - location])
        distance = np.linalg.norm(offsets, axis=1)
        cameras = 1 + len(seen)
        tokens = np.zeros((len(offsets), len(FEATURES)), dtype=np.float32)
        tokens[:, :3] = offsets / OFFSET_M
        tokens[:, 3:6] = offsets / np.maximum(distance, 1e-9)[:, None]
        tokens[cameras:, 6:9] = self._looks
        tokens[:, 9] = np.log1p(distance)
        tokens[:, 10] = np.log1p(len(points))
        tokens[1:cameras, 11] = 1
        tokens[cameras:, 12] = 1
        return torch.from_numpy(tokens)


def _spread(rows: Float, at_most: int) -> Float:
    """Return at most `at_most` rows, evenly spread."""
    if len(rows) <= at_most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, at_most).round().astype(np.int64)]


@dataclass(frozen=True, eq=False)
class SphereViews(TensorViews):
    """Labelled viewpoints and the locations that they share: about 33 kB a location at 640 tokens."""

    tokens: Tensor  # (L, T, len(FEATURES)) float32, zero where there is none
    padding: Tensor  # (L, T) bool, True where there is none
    rows: Tensor  # (B,) int64, location of each view
    axes: Tensor  # (B, 3) float32, its optical axis in the world
    labels: Tensor  # (B,) float32, 1 where it localizes
    scene: NDArray[np.int64]  # (B,) int64, number of each view's scene in the order given
    location: NDArray[np.int64]  # (B,) int64, location_id of each view, unique only within its scene


def load_sphere_views(
    dataset: Dataset,
    scenes: Sequence[SceneFolder],
    config: SharedConfig,
    options: SphereConfig,
    device: str = "cpu",
    progress: bool = True,
) -> SphereViews:
    """Read the labelled viewpoints of some scenes and describe their locations, on the CPU.

    Raises a TableError if a scene has no table or no labelled viewpoint, or its occlusion does not fit; a MapError if
    it has no landmarks, or its mapping cameras are not known.
    """
    tables = [labelled_rows(scene) for scene in scenes]
    tokens: list[Tensor] = []
    rows: list[NDArray[np.int64]] = []
    axes: list[Float] = []
    for scene, table in zip(scenes, tables, strict=True):
        cam_from_world = poses(table)
        locations, location_of = shared_locations(cam_from_world)
        rows.append(location_of + len(tokens))
        axes.append(cam_from_world[:, 2, :3])
        localization_map = scene.localization_map(dataset.camera, device)
        describer = LocationDescriber(localization_map, options)
        bar = tqdm(describer.describe(locations), f"describe {scene.name}", len(locations), disable=not progress)
        tokens += bar
    counts = torch.tensor([len(one) for one in tokens])
    padded = pad_sequence(tokens, batch_first=True)
    padding = torch.arange(int(counts.max())) >= counts[:, None]
    row = torch.from_numpy(np.concatenate(rows))
    axis = torch.from_numpy(np.concatenate(axes).astype(np.float32))
    return SphereViews(padded, padding, row, axis, *labels_of(tables, config))


class LocationBatches(IndexBatches):
    """Batches of whole locations of the views `chosen` (n,), each encoded once for all of its views.

    A batch has `batch_size` views on average.
    """

    numpy_order = True

    def __init__(self, views: SphereViews, chosen: NDArray[np.int64], batch_size: int, *options: Any) -> None:
        rows = views.rows.cpu().numpy()[chosen]
        self.views = views
        self._by_location = chosen[np.argsort(rows, kind="stable")]
        self._locations, self._counts = np.unique(rows, return_counts=True)
        self._starts = np.cumsum(self._counts) - self._counts
        per_batch = max(1, round(batch_size * len(self._locations) / max(1, len(chosen))))
        super().__init__(torch.arange(len(self._locations)), per_batch, *options)

    def collate(self, rows: Tensor, generator: torch.Generator) -> Batch:
        """Return this process's share of some locations, with all of their chosen views."""
        device = self.views.tokens.device
        share = self.share_of(rows).numpy()
        counts = self._counts[share]
        location = np.repeat(np.arange(len(share)), counts)
        place = np.arange(len(location)) - np.repeat(np.cumsum(counts) - counts, counts)
        views = torch.from_numpy(self._by_location[self._starts[share][location] + place]).to(device)
        at = torch.from_numpy(self._locations[share]).to(device)
        inputs = (self.views.tokens[at], self.views.padding[at], torch.from_numpy(location).to(device))
        return Batch((*inputs, self.views.axes[views]), self.views.labels[views], int(self._counts[rows.numpy()].sum()))


class SphereDataModule(ViewsDataModule):
    """Views of a dataset in batches of whole locations, without those held out (B,) to learn from."""

    def __init__(self, views: SphereViews, held_out: NDArray[np.bool_], batch_size: int, config: SharedConfig) -> None:
        super().__init__()
        self.views = views
        self.batch_size = batch_size
        self.config = config
        self.train_rows = np.flatnonzero(~held_out)
        self.val_rows = np.flatnonzero(held_out)

    def batches(self, rows: NDArray[np.int64], shuffle_seed: int | None = None) -> LocationBatches:
        """Return batches of rows, see `ViewsDataModule.batches`; all are of one size here."""
        return LocationBatches(self.views, rows, self.batch_size, shuffle_seed, self.share)
