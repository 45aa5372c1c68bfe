"""Labels a table of viewpoints, in shards that survive interruption."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from tqdm.auto import tqdm

from wheretolook.errors import MapError, TableError, WorkerError
from wheretolook.geometry import PinholeCamera, pose_error
from wheretolook.labelling.config import LabelConfig, LocalizerConfig
from wheretolook.labelling.localizer import Localizer
from wheretolook.mapping.extraction import ExtractorConfig
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.table import POSE_COLUMNS, fingerprint, poses, read_table, write_table
from wheretolook.worker_processes import end_with_parent, spawning

if TYPE_CHECKING:
    from wheretolook.rendering import Renderer


def label_viewpoints(
    table: pd.DataFrame,
    mesh: Path,
    landmarks: Path,
    camera: PinholeCamera,
    shards: Path,
    config: LabelConfig | None = None,
    extractor: ExtractorConfig | None = None,
    device: str = "cpu",
    progress: bool = True,
    description: str = "label",
) -> pd.DataFrame:
    """Render every viewpoint, localize its image against the map and measure the error (paper, Sec. 3.3).

    Finished shards lie in a folder named by all that decides a label (viewpoints, mesh, landmarks, settings), so that a
    run which was interrupted, or killed, goes on where it stopped and ends with the same table.

    Args:
        table: viewpoints, see `wheretolook.table.SCHEMA`.
        mesh: file of the scene's mesh.
        landmarks: file of the map's landmarks, with descriptors.
        camera: intrinsics of the viewpoints.
        shards: folder for unfinished work.
        config: how.
        extractor: what the map was made with.
        device: where images are rendered and descriptors matched.
        progress: show a progress bar.
        description: the bar's title.

    Returns:
        The table with status, error_m, error_deg and n_inliers filled in; the paper's label y follows from them by
        `wheretolook.table.is_good`.

    Raises:
        SceneError, MapError: the mesh or the landmarks cannot be used.
        TableError: the table is empty.
        WorkerError: a worker process was killed.
    """
    config, extractor = config or LabelConfig(), extractor or ExtractorConfig()
    if table.empty:
        raise TableError("no viewpoints to label", fix="Run the sample stage with other settings.")
    if Landmarks.load(landmarks).descriptors is None:
        raise MapError("landmarks without descriptors cannot be matched", path=landmarks, fix="Build the map again.")
    settings = [asdict(config.localizer), asdict(extractor), asdict(camera), fingerprint(mesh), fingerprint(landmarks)]
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    digest.update(pd.util.hash_pandas_object(table[["viewpoint_id", *POSE_COLUMNS]], index=False).to_numpy().tobytes())
    folder = shards / f"{digest.hexdigest()[:16]}-{config.shard_size}"
    folder.mkdir(parents=True, exist_ok=True)

    chunks = {
        folder / f"{begin:08d}.parquet": table.iloc[begin : begin + config.shard_size]
        for begin in range(0, len(table), config.shard_size)
    }
    missing = {path: chunk for path, chunk in chunks.items() if not _is_finished(path, chunk)}
    n_workers = min(config.workers or len(os.sched_getaffinity(0)), max(1, len(missing)))
    job = _Job(mesh, landmarks, camera, config.localizer, extractor, device)
    with tqdm(total=len(table), desc=description, unit="view", disable=not progress, smoothing=0.05) as bar:
        bar.update(len(table) - sum(map(len, missing.values())))
        bar.initial = bar.n  # so that the estimate counts only what is done now
        if missing:
            context = multiprocessing.get_context("spawn")
            pool = ProcessPoolExecutor(n_workers, context)
            try:
                with spawning():
                    futures = {pool.submit(_label_shard, job, path, chunk): chunk for path, chunk in missing.items()}
                for future in as_completed(futures):
                    future.result()
                    bar.update(len(futures[future]))
            except BrokenProcessPool as error:
                raise WorkerError(
                    "a labelling process was killed, probably for lack of memory",
                    value=f"{n_workers} workers",
                    fix="Lower label.workers and run again: finished shards are kept.",
                ) from error
            finally:
                pool.shutdown(wait=True, cancel_futures=True)
    return pd.concat([read_table(path) for path in chunks], ignore_index=True)


def label_rows(table: pd.DataFrame, renderer: Renderer, localizer: Localizer, camera: PinholeCamera) -> pd.DataFrame:
    """Label the rows of a table in this process; `label_viewpoints` is this over many processes and shards."""
    true_poses = poses(table)
    found = [localizer.localize(renderer.render(camera, pose[None]).rgb[0]) for pose in true_poses]
    estimates = np.stack(
        [np.full((3, 4), np.nan) if one.cam_from_world is None else one.cam_from_world for one in found]
    )
    error_m, error_deg = pose_error(estimates, true_poses)
    return table.assign(
        status=[one.status for one in found],
        error_m=error_m.astype(np.float32),
        error_deg=error_deg.astype(np.float32),
        n_inliers=np.array([len(one.inlier_rows) for one in found], dtype=np.int32),
    )


@dataclass(frozen=True)
class _Job:
    """All a worker process needs to start."""

    mesh: Path
    landmarks: Path
    camera: PinholeCamera
    localizer: LocalizerConfig
    extractor: ExtractorConfig
    device: str


_worker: tuple[_Job, Renderer, Localizer] | None = None


def _label_shard(job: _Job, path: Path, chunk: pd.DataFrame) -> None:
    global _worker
    if _worker is None or _worker[0] != job:  # not in a pool initializer, where an error would lose its type
        _worker = job, *_start_worker(job)
    _, renderer, localizer = _worker
    write_table(label_rows(chunk, renderer, localizer, job.camera), path)


def _start_worker(job: _Job) -> tuple[Renderer, Localizer]:
    import torch

    from wheretolook.rendering import WarpRenderer
    from wheretolook.scenes.loading import load_mesh

    end_with_parent()
    torch.set_num_threads(1)
    renderer = WarpRenderer(load_mesh(job.mesh), job.device)
    return renderer, Localizer(Landmarks.load(job.landmarks), job.camera, job.localizer, job.extractor, job.device)


def _is_finished(path: Path, chunk: pd.DataFrame) -> bool:
    """Whether a shard is whole; a damaged one is removed and made again."""
    if not path.exists():
        return False
    try:
        done = read_table(path)
    except TableError:
        path.unlink()
        return False
    return np.array_equal(done["viewpoint_id"], chunk["viewpoint_id"])
