"""Labels the viewpoints of one shard: what every worker does, whichever engine runs it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.dataset.viewpoint_table import CAMERA_ID, MATCH_FIELDS, PIXEL_FIELD, PIXELS, poses
from wheretolook.features.config import ExtractorConfig
from wheretolook.geometry.camera import Camera, PinholeCamera
from wheretolook.geometry.poses import Float, pose_error
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.pipeline import Step, run_pipeline
from wheretolook.utils.errors import WhereToLookError, WorkerError
from wheretolook.utils.processes import use_one_core

if TYPE_CHECKING:
    from wheretolook.features.keypoints import Keypoints
    from wheretolook.features.matching import Matches
    from wheretolook.localization.localizer import Localization, Localizer
    from wheretolook.rendering.types import Renderer

BATCH = 8
"""Viewpoints of 640 x 480 that are rendered, extracted and matched together, unless the extractor wants more.

Fewer of a larger camera: many workers share a GPU, and each holds its batches' images and scale spaces there.
"""

Tick = Callable[[int], None]


@dataclass(frozen=True)
class SceneJob:
    """All that a worker needs to label viewpoints of a scene; files of its mesh, and of landmarks with descriptors."""

    mesh: Path
    landmarks: Path
    camera: Camera = PinholeCamera()
    localizer: LocalizerConfig = LocalizerConfig()
    extractor: ExtractorConfig = ExtractorConfig()  # what the map was made with
    device: str = "cpu"  # with "cuda", workers spread over all GPUs
    store_matches: bool = False  # whether labelled rows get the columns of `viewpoints.table.MATCH_FIELDS`
    cameras: tuple[tuple[int, Camera], ...] = ()  # by number, where viewpoints say with which of several they look
    store_pixels: bool = False  # whether they also get `viewpoints.table.PIXEL_FIELD`


@dataclass(frozen=True, eq=False)
class Shard:
    """Some viewpoints of one scene, and the file their labels go to."""

    job: SceneJob
    path: Path
    rows: pd.DataFrame


@dataclass(frozen=True, eq=False)
class LabelledShard:
    """The viewpoints of a shard with their labels, and the time the worker spent in each step; steps overlap."""

    rows: pd.DataFrame
    seconds: dict[str, float] = field(default_factory=dict)


class ShardWorker:
    """Labels shards in this process; the renderer and map stay loaded until a shard of another scene comes.

    Its number among its engine's workers, from 0, decides the GPU that it uses.
    """

    def __init__(self, number: int = 0) -> None:
        import torch

        use_one_core()
        torch.set_num_threads(1)
        self.number = number
        self._scene: tuple[SceneJob, Renderer, Localizer] | None = None

    def label(self, job: SceneJob, rows: pd.DataFrame, tick: Tick = lambda n: None) -> LabelledShard:
        """Label viewpoints of a scene; `tick` is called with the number of viewpoints just finished.

        Raises a SceneError or MapError if mesh or landmarks cannot be used, a WorkerError if anything else fails.
        """
        try:
            seconds: dict[str, float] = {}
            renderer, localizer = self._open(job)
            cameras = dict(job.cameras) or job.camera
            options = (seconds, tick, job.store_matches, job.store_pixels)
            labelled = label_rows(rows, renderer, localizer, cameras, *options)
            return LabelledShard(labelled, seconds)
        except WhereToLookError:
            raise
        except Exception as error:
            problem = f"labelling failed: {type(error).__name__}: {error}"
            viewpoints = f"viewpoints {rows['viewpoint_id'].iloc[0]} to {rows['viewpoint_id'].iloc[-1]}"
            fix = "Finished shards are kept: mend the cause and run again."
            raise WorkerError(problem, path=job.mesh, value=viewpoints, fix=fix) from error

    def _open(self, job: SceneJob) -> tuple[Renderer, Localizer]:
        from wheretolook.localization.localizer import Localizer
        from wheretolook.mapping.landmarks import Landmarks
        from wheretolook.rendering.registry import make_renderer
        from wheretolook.scenes.loading import load_mesh

        if self._scene is None or self._scene[0] != job:
            import torch

            self._scene = None  # free its memory first
            device = job.device
            if device == "cuda":
                device = f"cuda:{self.number % max(1, torch.cuda.device_count())}"
            renderer = make_renderer(load_mesh(job.mesh), device)
            looked = (job.camera, job.localizer, job.extractor, device, job.landmarks.parent)
            localizer = Localizer(Landmarks.load(job.landmarks), *looked)
            self._scene = job, renderer, localizer
        return self._scene[1:]


def label_rows(
    table: pd.DataFrame,
    renderer: Renderer,
    localizer: Localizer,
    cameras: Camera | Mapping[int, Camera],
    seconds: dict[str, float] | None = None,
    tick: Tick = lambda n: None,
    store_matches: bool = False,
    store_pixels: bool = False,
) -> pd.DataFrame:
    """Render viewpoints, localize the images and measure the errors, in batched steps that overlap in this process.

    Of several cameras, each viewpoint's `camera_id` says which looks. The time spent in each step (render, extract,
    match, pose) is added to `seconds`, and `tick` is called with the number of viewpoints just finished. Returns the
    table with status, error_m, error_deg and n_inliers filled in, and with `viewpoints.table.MATCH_FIELDS` if
    `store_matches`, and also `PIXEL_FIELD` if `store_pixels`; those of earlier labels are dropped.
    """
    true_poses = poses(table)
    if not isinstance(cameras, Mapping):
        groups = [(cameras, np.arange(len(table)))]
    else:
        numbers = table[CAMERA_ID].to_numpy()
        groups = [(cameras[number], np.flatnonzero(numbers == number)) for number in np.unique(numbers).tolist()]
    together = max(BATCH, localizer.extractor.batch_of(640, 480))
    batches = [(camera, part) for camera, rows in groups for part in _batches(camera, rows, together)]

    def poses_of(batch: tuple[Camera, list[tuple[Keypoints, Matches]]]) -> list[Localization]:
        camera, matched = batch
        return [localizer.estimate(keypoints, rows, landmarks, camera) for keypoints, (rows, landmarks) in matched]

    steps = [  # a batch is of one camera, which goes with it from step to step
        Step("render", lambda batch: (batch[0], renderer.render(batch[0], true_poses[batch[1]]).rgb)),
        Step("extract", lambda batch: (batch[0], localizer.extract(batch[1]))),
        Step("match", lambda batch: (batch[0], list(zip(batch[1], localizer.match(batch[1], batch[0]), strict=True)))),
        Step("pose", poses_of),
    ]
    found: list[Localization] = []
    for batch in run_pipeline(batches, steps, seconds):
        found += batch
        tick(len(batch))
    results = [found[row] for row in np.argsort(np.concatenate([rows for _, rows in groups]))]
    none: Float = np.full((3, 4), np.nan)
    estimates = np.stack([none if result.cam_from_world is None else result.cam_from_world for result in results])
    error_m, error_deg = pose_error(estimates, true_poses)
    labelled = table.drop(columns=[*MATCH_FIELDS.names, *PIXEL_FIELD.names], errors="ignore").assign(
        status=[result.status for result in results],
        error_m=error_m.astype(np.float32),
        error_deg=error_deg.astype(np.float32),
        n_inliers=np.array([len(result.inlier_rows) for result in results], dtype=np.int32),
    )
    if not (store_matches or store_pixels):
        return labelled
    order = [np.argsort(result.matched_rows, kind="stable") for result in results]
    ragged: dict[str, Any] = {
        "matched_rows": [one.matched_rows[by].astype(np.int32) for one, by in zip(results, order, strict=True)],
        "inlier_rows": [np.sort(result.inlier_rows).astype(np.int32) for result in results],
    }
    if store_pixels:
        ragged[PIXELS] = [one.matched_pixels[by].ravel() for one, by in zip(results, order, strict=True)]
    return labelled.assign(**ragged)


def _batches(camera: Camera, rows: NDArray[np.int64], together: int) -> list[NDArray[np.int64]]:
    """Rows of views of one camera that go together, so many of 640 x 480."""
    size = min(together, max(1, together * 640 * 480 // (camera.width * camera.height)))
    return [rows[i : i + size] for i in range(0, len(rows), size)]
