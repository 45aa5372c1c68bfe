"""Label one shard of viewpoints in a worker: render, extract, match and localize, each step beside the next."""

from __future__ import annotations

import re
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import current_process
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import torch
import warp as wp
from numpy.typing import NDArray

from wheretolook.dataset.viewpoint_files import FIRST_FIELDS, MATCH_FIELDS
from wheretolook.dataset.viewpoint_table import APPEARANCE, CAMERA_ID, CHANGES, FIRST, PIXELS, poses
from wheretolook.features.extractor import ExtractorConfig, Keypoints
from wheretolook.features.matches import Matches
from wheretolook.geometry.camera import Camera, PinholeCamera
from wheretolook.geometry.poses import Float
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.localizer import Localization, Localizer, localization_errors
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.rendering.appearance import Appearance
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh
from wheretolook.utils.devices import run_halving
from wheretolook.utils.errors import WhereToLookError, WorkerError
from wheretolook.utils.processes import WorkerPool, cores

GPU_BATCH = 128
"""Viewpoints of 640 x 480 that a GPU labels at a time: more take more memory, and no clearly less time."""

_END = object()
"""Marks the end of the items."""


@dataclass(frozen=True)
class Step:
    """A step of a pipeline: a name for its time, and a function of the previous step's result."""

    name: str
    run: Callable[[Any], Any]


def run_pipeline(
    items: Iterable[Any], steps: list[Step], seconds: dict[str, float] | None = None, depth: int = 2
) -> Iterator[Any]:
    """Pass items through steps and yield the results of the last step in the order of the items.

    Steps that wait for a GPU or release the interpreter lock overlap; items are read in a thread of their own. The
    seconds spent in each step are added to `seconds`. `depth` is the number of items in flight for each step and for
    the source. Errors of a step or the source are raised here, and end the other threads.
    """
    iterator = iter(items)
    seconds = {} if seconds is None else seconds
    in_flight: deque[Future[Any]] = deque()
    threads = [ThreadPoolExecutor(1) for _ in range(len(steps) + 1)]
    try:
        while True:
            while len(in_flight) < depth * len(threads):
                future = threads[0].submit(next, iterator, _END)
                for thread, step in zip(threads[1:], steps, strict=True):
                    future = thread.submit(_run, step, future, seconds)
                in_flight.append(future)
            item = in_flight.popleft().result()
            if item is _END:
                return
            yield item
    finally:
        for thread in threads:
            thread.shutdown(wait=False, cancel_futures=True)
        for thread in threads:
            thread.shutdown()


def _run(step: Step, source: Future[Any], seconds: dict[str, float]) -> Any:
    item = source.result()
    if item is _END:
        return item
    start = time.perf_counter()
    item = step.run(item)
    seconds[step.name] = seconds.get(step.name, 0.0) + time.perf_counter() - start
    return item


@dataclass(frozen=True)
class SceneJob:
    """Everything that a worker needs to label viewpoints of a scene: files of mesh and landmarks, and settings."""

    mesh: Path
    landmarks: Path
    camera: Camera = PinholeCamera()
    localizer: LocalizerConfig = LocalizerConfig()
    extractor: ExtractorConfig = ExtractorConfig()  # of the map
    device: str = "cpu"  # with "cuda", workers are distributed over all GPUs
    store_matches: bool = False  # add `viewpoint_files.MATCH_FIELDS`
    cameras: tuple[tuple[int, Camera], ...] = ()  # by number, if viewpoints have a `camera_id`
    store_pixels: bool = False  # add `viewpoint_files.PIXEL_FIELD`, too
    appearance: float = 0.0  # highest strength of `rendering.appearance`; add the column `APPEARANCE`
    changes: float = 0.0  # strength of the changes in `changed_mesh`; add the column `CHANGES`
    changed_mesh: Path | None = None  # shown by the views of about half of the locations

    @property
    def on_gpu(self) -> bool:
        """Whether all steps run on a GPU, where learned features keep several processes busy.

        Appearances take a core 0.3 s for two megapixels.
        """
        pinholes = all(isinstance(camera, PinholeCamera) for camera in (self.camera, *dict(self.cameras).values()))
        on_cores = self.device == "cpu" or self.extractor.method != "opencv" or self.appearance > 0
        return pinholes and not on_cores

    @property
    def processes(self) -> int:
        """Number of processes that label the scene: one for each GPU if all steps run there, or for each core."""
        if not self.on_gpu:
            return cores()
        return torch.cuda.device_count() if self.device == "cuda" else 1


@dataclass(frozen=True, eq=False)
class Shard:
    """Some viewpoints of one scene, and the file for their labels."""

    job: SceneJob
    path: Path
    rows: pd.DataFrame


@dataclass(frozen=True, eq=False)
class LabelledShard:
    """The viewpoints of a shard with labels, and the seconds spent in each step; steps overlap."""

    rows: pd.DataFrame
    seconds: dict[str, float] = field(default_factory=dict)


class ShardWorker:
    """Labels shards in this process; renderer and map stay loaded until a shard of another scene comes.

    Its number selects the GPU: those of a pool follow one another.
    """

    def __init__(self, number: int = 0) -> None:
        cv2.setNumThreads(1)
        torch.set_num_threads(1)
        self.number = number
        self._scene: tuple[SceneJob, Localizer, WarpRenderer, WarpRenderer | None] | None = None

    def label(self, job: SceneJob, rows: pd.DataFrame) -> LabelledShard:
        """Label viewpoints of a scene.

        Raises SceneError or MapError if mesh or landmarks cannot be used, WorkerError if anything else fails.
        """
        try:
            seconds: dict[str, float] = {}
            localizer, renderer, changed = self._open(job)
            return LabelledShard(label_rows(rows, job, localizer, renderer, changed, seconds), seconds)
        except WhereToLookError:
            raise
        except Exception as error:
            problem = f"labelling failed: {type(error).__name__}: {error}"
            viewpoints = f"viewpoints {rows['viewpoint_id'].iloc[0]} to {rows['viewpoint_id'].iloc[-1]}"
            fix = "Fix the cause and run again; finished shards are kept."
            raise WorkerError(problem, path=job.mesh, value=viewpoints, fix=fix) from error

    def _open(self, job: SceneJob) -> tuple[Localizer, WarpRenderer, WarpRenderer | None]:
        if self._scene is None or self._scene[0] != job:
            self._scene = None  # free its memory first
            device = job.device
            if device == "cuda":
                device = f"cuda:{self.number % max(1, torch.cuda.device_count())}"
            renderer = WarpRenderer(load_mesh(job.mesh), device)
            changed = WarpRenderer(load_mesh(job.changed_mesh), device) if job.changed_mesh else None
            landmarks = Landmarks.load(job.landmarks)
            map_dir = job.landmarks.parent
            localizer = Localizer(landmarks, job.camera, job.localizer, job.extractor, device, map_dir)
            self._scene = job, localizer, renderer, changed
        return self._scene[1:]


_worker: ShardWorker | None = None


def run_local(shards: Sequence[Shard], workers: int) -> Iterator[tuple[Shard, LabelledShard]]:
    """Label shards in worker processes, begun in this order, and yield them as they are finished.

    Raises what a worker raises, and WorkerError if workers are killed repeatedly.
    """
    with WorkerPool(min(workers, len(shards))) as pool:
        yield from pool.map_unordered(_label_shard, shards)


def _label_shard(shard: Shard) -> LabelledShard:
    global _worker
    number = re.split("[-:]", current_process().name)[-1]  # among those that the parent has started
    _worker = _worker or ShardWorker(int(number))
    return _worker.label(shard.job, shard.rows)


def label_rows(
    table: pd.DataFrame,
    job: SceneJob,
    localizer: Localizer,
    renderer: WarpRenderer,
    changed: WarpRenderer | None = None,
    seconds: dict[str, float] | None = None,
) -> pd.DataFrame:
    """Render viewpoints, localize the images and measure the errors, in batched steps that overlap.

    `renderer` and `changed` show the two meshes of the job. The seconds spent in each step (render, extract, match,
    pose) are added to `seconds`. A batch that exceeds a GPU's memory is halved. Returns the table with new status,
    error_m, error_deg and n_inliers, with `viewpoint_files.FIRST_FIELDS` by several hypotheses, `MATCH_FIELDS` and
    `PIXEL_FIELD` if the job stores them. With an `appearance` above 0 images are changed at strengths drawn up to it
    (`rendering.appearance`), which the column `APPEARANCE` holds. The changed mesh is shown by the views of locations drawn
    by the localizer's seed, to which the column `CHANGES` assigns the job's `changes`.
    """
    true_poses = poses(table)
    seed = localizer.config.seed
    drawn = Appearance.of_views(true_poses, job.appearance, seed) if job.appearance else []
    is_changed = _is_changed(table, seed) if changed else np.zeros(len(table), dtype=bool)
    batches = []
    batch_size = max(GPU_BATCH if localizer.in_batches else 8, localizer.extractor.batch_of(640, 480))
    for camera, rows in _by_camera(table, job):
        size = min(batch_size, max(1, batch_size * 640 * 480 // (camera.width * camera.height)))
        shown_in = [(renderer, rows[~is_changed[rows]])]
        if changed:
            shown_in.append((changed, rows[is_changed[rows]]))
        for shown, part in shown_in:
            for start in range(0, len(part), size):
                batch = part[start : start + size]
                batches.append(_Batch(shown, camera, batch, true_poses[batch], [drawn[row] for row in batch if drawn]))
    labeller = _BatchLabeller(localizer)
    steps = [
        Step("render", labeller.render),
        Step("extract", labeller.extract),
        Step("match", labeller.match),
        Step("pose", labeller.estimate),
    ]
    localizations = [result for batch in run_pipeline(batches, steps, seconds) for result in batch]
    order = np.argsort(np.concatenate([batch.rows for batch in batches]))
    results = [localizations[row] for row in order]
    columns = _labels(results, true_poses)
    if localizer.config.method == "hypotheses":
        columns |= _labels([result.first or result for result in results], true_poses, FIRST)
    if job.store_matches or job.store_pixels:
        columns |= _matches(results, job.store_pixels)
    if drawn:
        columns[APPEARANCE] = np.array([one.strength for one in drawn], dtype=np.float32)
    if changed:
        columns[CHANGES] = (job.changes * is_changed).astype(np.float32)
    old = [*FIRST_FIELDS.names, *MATCH_FIELDS.names, PIXELS, APPEARANCE, CHANGES]
    return table.drop(columns=old, errors="ignore").assign(**columns)


def _by_camera(table: pd.DataFrame, job: SceneJob) -> list[tuple[Camera, NDArray[np.int64]]]:
    """Return each camera of the job with the rows of its viewpoints."""
    if not job.cameras:
        return [(job.camera, np.arange(len(table)))]
    cameras = dict(job.cameras)
    numbers = table[CAMERA_ID].to_numpy()
    return [(cameras[number], np.flatnonzero(numbers == number)) for number in np.unique(numbers).tolist()]


@dataclass(frozen=True, eq=False)
class _Batch:
    """Some viewpoints that one renderer shows to one camera."""

    renderer: WarpRenderer
    camera: Camera
    rows: NDArray[np.int64]  # (B,) of the table
    cam_from_world: Float  # (B, 3, 4)
    drawn: Sequence[Appearance]  # B, or none


class _BatchLabeller:
    """Steps by which a batch of views is labelled; the batch goes with its images, keypoints and matches."""

    def __init__(self, localizer: Localizer) -> None:
        self.localizer = localizer

    def render(self, batch: _Batch) -> tuple[_Batch, Sequence[NDArray[np.uint8]]]:
        extractor = self.localizer.extractor
        on_device = extractor.on_gpu and extractor.config.method == "opencv" and not batch.drawn
        views = np.arange(len(batch.rows))
        camera = batch.camera
        if on_device and isinstance(camera, PinholeCamera):
            return batch, run_halving(lambda some: _images_on_device(batch, camera, some), views)
        return batch, run_halving(lambda some: _images(batch, some), views)

    def extract(self, rendered: tuple[_Batch, Sequence[NDArray[np.uint8]]]) -> tuple[_Batch, list[Keypoints]]:
        batch, images = rendered
        return batch, run_halving(self.localizer.extractor.extract_batch, images)

    def match(self, extracted: tuple[_Batch, list[Keypoints]]) -> tuple[_Batch, list[Keypoints], list[Matches]]:
        batch, keypoints = extracted
        return batch, keypoints, run_halving(lambda some: self.localizer.match(some, batch.camera), keypoints)

    def estimate(self, matched: tuple[_Batch, list[Keypoints], list[Matches]]) -> list[Localization]:
        batch, keypoints, matches = matched
        return self.localizer.estimate_batch(keypoints, matches, batch.camera)


def _images_on_device(batch: _Batch, camera: PinholeCamera, views: NDArray[np.int64]) -> list[torch.Tensor]:
    """Render some views (V,) of a batch as images (H, W, 3) on the device."""
    colors = batch.renderer.colors(camera, batch.cam_from_world[views])
    return [image for block in colors for image in wp.to_torch(block)]


def _images(batch: _Batch, views: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Render some views (V,) of a batch as images (V, H, W, 3), with their appearances if these are drawn."""
    seen = batch.renderer.render(batch.camera, batch.cam_from_world[views])
    if not batch.drawn:
        return seen.rgb
    rendered = zip(views, seen.rgb, seen.depth_m, strict=True)
    return np.stack([batch.drawn[view].apply(rgb, batch.camera, depth_m) for view, rgb, depth_m in rendered])


def _is_changed(table: pd.DataFrame, seed: int) -> NDArray[np.bool_]:
    """Draw from a seed whether each viewpoint (B,) shows the changed scene, alike for all of a location."""
    locations, row = np.unique(table["location_id"], return_inverse=True)
    return np.array([np.random.default_rng([seed, number]).random() < 0.5 for number in locations.tolist()])[row]


def _labels(results: Sequence[Localization], true_poses: Float, prefix: str = "") -> dict[str, Any]:
    """Columns of status, errors and inliers, by their names with a prefix."""
    error_m, error_deg = localization_errors(results, true_poses)
    return {
        f"{prefix}status": [result.status for result in results],
        f"{prefix}error_m": error_m.astype(np.float32),
        f"{prefix}error_deg": error_deg.astype(np.float32),
        f"{prefix}n_inliers": np.array([len(result.inlier_rows) for result in results], dtype=np.int32),
    }


def _matches(results: Sequence[Localization], store_pixels: bool) -> dict[str, Any]:
    """Columns of matched landmarks and inliers, in ascending order of the landmarks, and optionally of pixels."""
    orders = [(result, np.argsort(result.matched_rows, kind="stable")) for result in results]
    columns: dict[str, Any] = {
        "matched_rows": [result.matched_rows[order].astype(np.int32) for result, order in orders],
        "inlier_rows": [np.sort(result.inlier_rows).astype(np.int32) for result in results],
    }
    if store_pixels:
        columns[PIXELS] = [result.matched_pixels[order].ravel() for result, order in orders]
    return columns
