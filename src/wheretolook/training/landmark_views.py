"""Labelled viewpoints by their visible landmarks: the training data of the learners without bins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

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
from wheretolook.inputs.statistics import FeatureStatistics
from wheretolook.training.config import SharedConfig
from wheretolook.training.data import Batch, IndexBatches, TensorViews, ViewsDataModule, labelled_rows
from wheretolook.training.fit import home_device
from wheretolook.training.learner import TrainingJob
from wheretolook.training.provenance import training_scenes
from wheretolook.training.trained_network import TrainingRange, camera_quantities, view_quantities

DISTANCES = [ATTRIBUTES.index(name) for name in OF_SIZE]


@dataclass(frozen=True, eq=False)
class LandmarkViews(TensorViews):
    """Labelled viewpoints of some scenes, by at most so many of their visible landmarks each, in random order."""

    starts: Tensor  # (B + 1,) int64; view b has entries `starts[b]` to `starts[b + 1]`
    values: Tensor  # (E, len(ATTRIBUTES)) float16
    n_visible: Tensor  # (B,) int64, landmarks visible from each view
    labels: Tensor  # (B,) float32, 1 where the viewpoint localizes
    error_m: Tensor  # (B,) float32, position error; infinite where it is not localized or its orientation is off
    scene: NDArray[np.int64]  # (B,) index of each view's scene in the order given
    location: NDArray[np.int64]  # (B,) location_id of each view, unique only within its scene
    quantities: Float  # (B, 6), `wheretolook.training.trained_network.QUANTITIES`
    detected: Tensor | None = None  # (E,) bool, whether the localizer detected the landmark; None if not requested

    def __len__(self) -> int:
        return len(self.labels)


def load_landmark_views(
    dataset: Dataset,
    scenes: Sequence[SceneFolder],
    config: SharedConfig,
    max_landmarks: int,
    device: str = "cpu",
    progress: bool = True,
    matches: bool = False,
) -> LandmarkViews:
    """Describe at most `max_landmarks` visible landmarks of each labelled viewpoint of some scenes, on the CPU.

    With `matches`, the landmarks that the localizer detected are marked: the inliers of a view localized near its pose,
    none of one localized elsewhere, all matches of one that was not localized. Landmarks that the map's occlusion hides
    do not count.

    Raises:
        TableError: a scene has no table or no labelled viewpoint, its occlusion does not fit, or matches are not stored.
        MapError: a scene has no landmarks.
    """
    tables = [labelled_rows(scene, matches) for scene in scenes]
    parts: list[tuple[Tensor, ...]] = []
    viewpoints: list[pd.DataFrame] = []
    generator = torch.Generator().manual_seed(config.seed)
    with tqdm(total=sum(map(len, tables)), desc="describe views", unit="view", disable=not progress) as bar:
        for number, (scene, table) in enumerate(zip(scenes, tables, strict=True)):
            describer = LandmarkDescriber(scene.localization_map(device=device))
            # 2,048 views have some million landmarks
            for camera, rows in views_by_camera(scene, table, 2048):
                block = table.iloc[rows].assign(scene=number)
                described = describer.of_camera(camera).describe(poses(block))
                kept = _sample(described, max_landmarks, generator)
                values = described.values[kept].to("cpu", torch.float16)
                of_views = view_quantities(described, described.counts, camera_quantities(camera))
                detected = _detected(described, block) if matches else torch.zeros(len(described.rows))
                parts.append((values, described.counts.cpu(), torch.from_numpy(of_views), detected[kept.cpu()]))
                viewpoints.append(block)
                bar.update(len(block))
    values, n_visible, quantities, detected = (torch.cat(column) for column in zip(*parts, strict=True))
    table = pd.concat(viewpoints, ignore_index=True)
    starts = torch.zeros(len(table) + 1, dtype=torch.int64)
    starts[1:] = n_visible.clamp(max=max_landmarks).cumsum(0)
    good = is_good(table, config.max_error_m, config.max_error_deg)
    error_m = np.where(is_good(table, np.inf, config.max_error_deg), table["error_m"], np.inf)
    return LandmarkViews(
        starts=starts,
        values=values,
        n_visible=n_visible,
        labels=torch.from_numpy(good.astype(np.float32)),
        error_m=torch.from_numpy(error_m.astype(np.float32)),
        scene=table["scene"].to_numpy(),
        location=table["location_id"].to_numpy(np.int64),
        quantities=quantities.numpy(),
        detected=detected if matches else None,
    )


def _detected(described: ViewLandmarks, table: pd.DataFrame) -> Tensor:
    """Return whether each entry's landmark was detected in its view, (E,) bool, on the CPU."""
    rows = described.rows.cpu().numpy()
    starts = described.starts.cpu().numpy()
    detected = np.zeros(len(rows), dtype=bool)
    localized = (table["status"] == LOCALIZED).to_numpy()
    # inliers of a pose that is localized within 50 cm and 5 degrees count as correct matches
    correct = is_good(table, 0.5, 5.0)
    for view, (inliers, matched) in enumerate(zip(table["inlier_rows"], table["matched_rows"], strict=True)):
        part = slice(starts[view], starts[view + 1])
        if correct[view] or not localized[view]:
            detected[part] = np.isin(rows[part], inliers if localized[view] else matched)
    return torch.from_numpy(detected)


def _sample(described: ViewLandmarks, limit: int, generator: torch.Generator) -> Tensor:
    """Draw at most so many landmarks of each view; return their entries (n,), in random order within each view."""
    views = described.views
    key = views.double() + torch.rand(len(views), generator=generator, dtype=torch.float64).to(views.device) * 0.999
    place = torch.arange(len(views), device=views.device) - described.starts[views]  # views stay where they are
    return key.argsort()[place < limit]


class LandmarkBatches(IndexBatches):
    """Batches of views for `SetNetwork`: a random window of each view's landmarks, of `width` at most.

    Unshuffled views have the window that begins with their first landmark. `max_scale` above 1 scales the scenes of
    shuffled views by a random factor in [1 / max_scale, max_scale], see `random_log_scales`: distances and the position
    error grow by the factor, and the label follows from the grown error and `max_error_m`.
    """

    def __init__(
        self,
        views: LandmarkViews,
        rows: Tensor,
        width: int,
        batch_size: int,
        shuffle_seed: int | None = None,
        share: tuple[int, int] = (0, 1),
        max_scale: float = 1,
        max_error_m: float = 0.05,
    ) -> None:
        super().__init__(rows.to(views.device), batch_size, shuffle_seed, share)
        self.views = views
        self.width = width
        self.max_scale = max_scale
        self.max_error_m = max_error_m

    def collate(self, rows: Tensor, generator: torch.Generator) -> Batch:
        """Return this process's share of the views in `rows`."""
        views = self.views
        first = torch.zeros(len(rows), device=rows.device)
        log_scale = None
        if self.shuffle_seed is not None:  # landmarks are in random order, so any window is a random sample
            first = torch.rand(len(rows), generator=generator, device=rows.device)
            log_scale = random_log_scales(len(rows), self.max_scale, generator)
        share = self.share_of(rows)
        starts = views.starts[share]
        lengths = views.starts[share + 1] - starts
        n_sampled = lengths.clamp(max=self.width)
        steps = torch.arange(int(n_sampled.max()) if len(n_sampled) else 0, device=rows.device)
        place = ((self.share_of(first) * lengths).long()[:, None] + steps) % lengths.clamp(min=1)[:, None]
        entries = (starts[:, None] + place).clamp(max=len(views.values) - 1)
        values = views.values[entries].float()
        labels = views.labels[share]
        if log_scale is not None:
            log_scale = self.share_of(log_scale)
            values[..., DISTANCES] += log_scale[:, None, None]
            labels = (views.error_m[share] * log_scale.exp() < self.max_error_m).float()
        detected = torch.full(entries.shape, torch.nan, device=rows.device)
        if views.detected is not None:
            detected = torch.where(steps < n_sampled[:, None], views.detected[entries].float(), detected)
        return Batch((values, n_sampled, views.n_visible[share], detected), labels, len(rows))


def random_log_scales(count: int, max_scale: float, generator: torch.Generator) -> Tensor | None:
    """Return logarithms (count,) of factors by which scenes are scaled, uniform in the logarithm; None for no scaling.

    A scene and its map, scaled as a whole, look the same and give the same matches, so a network can train on rooms of
    every size without mapping them.
    """
    if max_scale == 1:
        return None
    return (torch.rand(count, generator=generator, device=generator.device) * 2 - 1) * log(max_scale)


class LandmarkDataModule(ViewsDataModule):
    """The `LandmarkViews` of a dataset, with statistics and the range of the training views.

    See `load_landmark_views` for `max_landmarks`, `matches` and what is raised.
    """

    views: LandmarkViews

    def __init__(self, task: TrainingJob, max_landmarks: int, matches: bool = False) -> None:
        super().__init__()
        self.config = task.config
        self.options = task.options
        dataset = task.dataset
        device = home_device(task.config)
        scenes = training_scenes(dataset)
        self.views = load_landmark_views(dataset, scenes, self.config, max_landmarks, device, task.progress, matches)
        trained_on = ~self.split(dataset)
        entries = torch.from_numpy(trained_on).repeat_interleave(self.views.starts.diff())
        self.statistics = FeatureStatistics.of_attributes(self.views.values[entries].float())
        self.training_range = TrainingRange.of(self.views.quantities[trained_on])
