"""Labelled viewpoints as the landmarks they see, one by one: what the learners without bins read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import ceil, log
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm.auto import tqdm

from wheretolook.dataset.layout import Dataset, SceneFolder, views_by_camera
from wheretolook.dataset.viewpoint_table import LOCALIZED, is_good, poses
from wheretolook.geometry.poses import Float
from wheretolook.inputs.channels import ATTRIBUTES, OF_SIZE
from wheretolook.inputs.landmark_features import LandmarkDescriber, ViewLandmarks
from wheretolook.training.attribute_statistics import AttributeStatistics
from wheretolook.training.config import SharedConfig
from wheretolook.training.data import Batch, TensorViews, ViewsDataModule, labelled_rows, validation_views
from wheretolook.training.fit import home_device
from wheretolook.training.learner import Task
from wheretolook.training.scenes import training_scenes
from wheretolook.training.training_range import TrainingRange, camera_quantities, view_quantities

DISTANCES = [ATTRIBUTES.index(name) for name in OF_SIZE]

NEAR = 0.5, 5.0
"""Metres and degrees within which a pose is that of the view, and its inliers are right. Elsewhere the map looks alike:
what agrees there are wrong matches."""

BLOCK = 2048  # views described at a time: some million landmarks


@dataclass(frozen=True, eq=False)
class LandmarkViews(TensorViews):
    """Labelled viewpoints of some scenes, by the landmarks they see.

    A view's landmarks are in random order, and at most `most` of them are kept: any first few are a random sample.
    """

    starts: Tensor  # (B + 1,) int64; view b has entries `starts[b]` to `starts[b + 1]`
    values: Tensor  # (E, len(ATTRIBUTES)) float16
    n_visible: Tensor  # (B,) int64, landmarks that each view sees
    axis_height: Tensor  # (B,) float32, z of the optical axis in the world
    labels: Tensor  # (B,) float32, 1 where the viewpoint localizes
    error_m: Tensor  # (B,) float32, error of its position, infinite where it is not localized or its orientation is off
    scene: NDArray[np.int64]  # (B,) int64, number of each view's scene in the order given
    location: NDArray[np.int64]  # (B,) int64, location_id of each view, unique only within its scene
    quantities: Float  # (B, 6), `wheretolook.training.training_range.QUANTITIES`
    # (E,) bool, whether the localizer found the landmark; None where that was not asked for
    found: Tensor | None = None

    def __len__(self) -> int:
        return len(self.labels)


def load_landmark_views(
    dataset: Dataset,
    scenes: Sequence[SceneFolder],
    config: SharedConfig,
    most: int,
    device: str = "cpu",
    progress: bool = True,
    matches: bool = False,
) -> LandmarkViews:
    """Describe what the labelled viewpoints of some scenes see, `most` landmarks of a view at most; on the CPU.

    With `matches` it is told which landmarks the localizer found: the inliers of a view that was localized near where
    it is, none of one that was localized elsewhere, and all that were matched in one that was not localized. Landmarks
    that the view does not see by the map's occlusion do not count.

    Raises a TableError if a scene has no table or no labelled viewpoint, its occlusion does not fit, or the matches are
    asked for but not stored; a MapError if it has no landmarks.
    """
    tables = [(scene, labelled_rows(scene, matches)) for scene in scenes]
    blocks: list[LandmarkViews] = []
    generator = torch.Generator().manual_seed(config.seed)
    total = sum(len(table) for _, table in tables)
    with tqdm(total=total, desc="describe views", unit="view", disable=not progress) as bar:
        for number, (scene, table) in enumerate(tables):
            describer = LandmarkDescriber(scene.localization_map(device=device))
            cam_from_world = poses(table)
            good = is_good(table, config.max_error_m, config.max_error_deg)
            error_m = np.where(is_good(table, np.inf, config.max_error_deg), table["error_m"], np.inf)
            of_views = np.stack([cam_from_world[:, 2, 2], good, error_m]).astype(np.float32)
            location = table["location_id"].to_numpy(np.int64)
            for camera, rows in views_by_camera(scene, table, BLOCK):
                described = describer.of_camera(camera).describe(cam_from_world[rows])
                found = _found(described, table.iloc[rows]) if matches else None
                starts, kept = _some_of_each(described, most, generator)
                values = described.values[kept].to("cpu", torch.float16)
                counts = described.counts.cpu()
                found = None if found is None else found[kept.cpu()]
                of_scene = np.full(len(described), number), location[rows]
                quantities = view_quantities(described, described.counts, camera_quantities(camera))
                height, label, off_m = torch.from_numpy(of_views[:, rows])
                blocks.append(
                    LandmarkViews(starts.cpu(), values, counts, height, label, off_m, *of_scene, quantities, found)
                )
                bar.update(len(described))
    return _joined(blocks)


def _found(described: ViewLandmarks, table: pd.DataFrame) -> Tensor:
    """(E,) bool, on the CPU: whether each entry's landmark was found in its view."""
    rows = described.rows.cpu().numpy()
    starts = described.starts.cpu().numpy()
    found = np.zeros(len(rows), dtype=bool)
    localized = (table["status"] == LOCALIZED).to_numpy()
    near = is_good(table, *NEAR)
    for view, (inliers, matched) in enumerate(zip(table["inlier_rows"], table["matched_rows"], strict=True)):
        part = slice(starts[view], starts[view + 1])
        if near[view] or not localized[view]:
            found[part] = np.isin(rows[part], inliers if localized[view] else matched)
    return torch.from_numpy(found)


def _some_of_each(described: ViewLandmarks, most: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """At most so many landmarks of each view, at random: their starts (B + 1,) and entries, in random order."""
    views = described.views
    key = views.double() + torch.rand(len(views), generator=generator, dtype=torch.float64).to(views.device) * 0.999
    order = key.argsort()
    place = torch.arange(len(views), device=views.device) - described.starts[views]  # views stay where they are
    kept = order[place < most]
    starts = torch.zeros_like(described.starts)
    starts[1:] = described.counts.clamp(max=most).cumsum(0)
    return starts, kept


def _joined(blocks: Sequence[LandmarkViews]) -> LandmarkViews:
    lengths = torch.cat([block.starts.diff() for block in blocks])
    starts = torch.zeros(len(lengths) + 1, dtype=torch.int64)
    starts[1:] = lengths.cumsum(0)
    joined: dict[str, Any] = {"starts": starts}
    for name in ("values", "n_visible", "axis_height", "labels", "error_m", "scene", "location", "quantities", "found"):
        parts = [getattr(block, name) for block in blocks if getattr(block, name) is not None]
        if parts:
            joined[name] = torch.cat(parts) if isinstance(parts[0], Tensor) else np.concatenate(parts)
    return LandmarkViews(**joined)


class LandmarkLoader:
    """Batches of views for `SetNetwork`: a window of each view's landmarks, of `width` at most.

    With several processes, every one cuts the same batches and keeps its share of each; a share can be empty. The
    `shuffle_seed` is that of order, windows and sizes; None goes through the views in order, from their first landmark.

    Shuffled views can come enlarged, from 1 / `enlarged` to `enlarged` times as large, evenly in the logarithm: a scene
    and its map, made larger as a whole, look the same and give the same matches. All distances grow with the scene, the
    error of the position too, and the label follows from that and `max_error_m`. So a network sees rooms of every size
    without any of them being mapped.
    """

    def __init__(
        self,
        views: LandmarkViews,
        rows: Tensor,
        batch_size: int,
        width: int,
        shuffle_seed: int | None = None,
        rank: int = 0,
        world_size: int = 1,
        enlarged: float = 1.0,
        max_error_m: float = 0.05,
    ) -> None:
        self.views = views
        self.rows = rows.to(views.labels.device)
        self.batch_size = batch_size
        self.width = width
        self.enlarged = enlarged
        self.max_error_m = max_error_m
        self.shuffle_seed = shuffle_seed
        self.rank = rank
        self.world_size = world_size
        self._pass = 0

    def __len__(self) -> int:
        return ceil(len(self.rows) / self.batch_size)

    def __iter__(self) -> Iterator[Batch]:
        views = self.views
        rows = self.rows
        device = self.rows.device
        generator = torch.Generator(device)
        if self.shuffle_seed is not None:
            generator.manual_seed(1_000_003 * self.shuffle_seed + self._pass)
            self._pass += 1  # another order every time
            rows = rows[torch.randperm(len(rows), generator=generator, device=device)]
        for part in rows.split(self.batch_size):
            first = torch.zeros(len(part), device=device)
            growth = None
            if self.shuffle_seed is not None:  # landmarks lie in random order, so any window is a random sample
                first = torch.rand(len(part), generator=generator, device=device)
                if self.enlarged > 1:
                    growth = torch.rand(len(part), generator=generator, device=device) * 2 - 1
                    growth = (growth * log(self.enlarged)).tensor_split(self.world_size)[self.rank]
            share, first = (whole.tensor_split(self.world_size)[self.rank] for whole in (part, first))
            starts = views.starts[share]
            lengths = views.starts[share + 1] - views.starts[share]
            taken = lengths.clamp(max=self.width)
            steps = torch.arange(int(taken.max()) if len(taken) else 0, device=device)
            place = ((first * lengths).long()[:, None] + steps) % lengths.clamp(min=1)[:, None]
            entries = (starts[:, None] + place).clamp(max=len(views.values) - 1)
            values = views.values[entries].float()
            labels = views.labels[share]
            if growth is not None:
                values[..., DISTANCES] += growth[:, None, None]
                labels = (views.error_m[share] * growth.exp() < self.max_error_m).float()
            known = (taken, views.n_visible[share], views.axis_height[share])
            yield Batch((values, *known, self._found(entries, steps < taken[:, None])), labels, len(part))

    def _found(self, entries: Tensor, own: Tensor) -> Tensor:
        """Whether the landmarks of entries (B, K) were found, where they are a view's `own` (B, K); NaN else."""
        found = torch.full(entries.shape, torch.nan, device=entries.device)
        return found if self.views.found is None else torch.where(own, self.views.found[entries].float(), found)


class LandmarkDataModule(ViewsDataModule):
    """The `LandmarkViews` of a task's dataset, and of those to learn from statistics over the landmarks and the range.

    See `load_landmark_views` for the landmarks kept of a view, for matches, and for what is raised.
    """

    views: LandmarkViews
    train_rows: Tensor
    val_rows: Tensor

    def __init__(self, task: Task, most: int, matches: bool = False) -> None:
        super().__init__()
        self.config = task.config
        self.options = task.options
        dataset = task.dataset
        device = home_device(task.config)
        scenes = training_scenes(dataset)
        self.views = load_landmark_views(dataset, scenes, self.config, most, device, task.progress, matches)
        held_out = torch.from_numpy(validation_views(dataset, self.views.scene, self.views.location, self.config))
        self.train_rows, self.val_rows = (torch.nonzero(side)[:, 0] for side in (~held_out, held_out))
        of_train = (~held_out).repeat_interleave(self.views.starts.diff())
        self.statistics = AttributeStatistics.of(self.views.values[of_train].float())
        self.training_range = TrainingRange.of(self.views.quantities[~held_out.numpy()], self.options.enlarged)
