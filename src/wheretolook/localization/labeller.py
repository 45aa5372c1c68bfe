"""Label viewpoints by rendering and localizing them, in processes of this machine or on a Ray cluster."""

from __future__ import annotations

import getpass
import hashlib
import json
import os
import socket
import tempfile
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from tqdm.auto import tqdm

from wheretolook.dataset.viewpoint_files import SCHEMA, read_table, write_table
from wheretolook.dataset.viewpoint_table import CAMERA_ID, LABELS
from wheretolook.localization.config import LabelConfig, versions
from wheretolook.localization.shard import LabelledShard, SceneJob, Shard, ShardWorker, run_local
from wheretolook.rendering.warp_renderer import method_on
from wheretolook.utils.errors import ConfigError, TableError, WhereToLookError, WorkerError
from wheretolook.utils.files import atomic_write, fingerprint, sha256, write_json
from wheretolook.utils.package import require

MANIFEST = "manifest.json"
"""File in the folder of shards with the settings of the labels; later `labels.json` next to the table."""


@dataclass(frozen=True, eq=False)
class LabelTask:
    """A scene to label: its name, the workers' input, its viewpoints (`viewpoint_files.SCHEMA`), folder of shards."""

    name: str
    job: SceneJob
    table: pd.DataFrame
    shards: Path


@dataclass(frozen=True, eq=False)
class LabelledScene:
    """A scene all of whose viewpoints are labelled.

    Attributes:
        task: the scene.
        table: the viewpoints with the columns that `shard.label_rows` adds; the paper's label y is
            `viewpoint_table.is_good`.
        manifest: versions, settings and fingerprints of the inputs, and each shard's name and SHA-256.
        seconds: the workers' time in each step, for shards labelled in this run.
    """

    task: LabelTask
    table: pd.DataFrame
    manifest: dict[str, Any]
    seconds: dict[str, float] = field(default_factory=dict)


def label_scenes(
    tasks: Sequence[LabelTask], config: LabelConfig, progress: bool = True, description: str = "label"
) -> Generator[LabelledScene, None, None]:
    """Render every viewpoint, localize its image against the map and measure the error (paper, Sec. 3.3).

    Work is split into shards. A finished shard is a file named by a hash of everything that decides its labels
    (viewpoints, mesh, landmarks, settings, versions). So an interrupted run resumes and ends with the same table, for
    any engine and number of workers. `description` is the title of the progress bar. Yields scenes as they are
    finished; the caller stores their tables, and may then remove their shards.

    Raises SceneError or MapError if a mesh or landmarks cannot be used, TableError if a table is empty, WorkerError if
    workers fail or are killed repeatedly, StorageError if a shard cannot be written, ConfigError if the Ray engine
    cannot be used.
    """
    scenes = [_SceneInProgress.of(task, config.shard_size) for task in tasks]
    scene_of_shard = {shard: scene for scene in scenes for shard in scene.missing}
    missing = list(scene_of_shard)
    total = sum(len(task.table) for task in tasks)
    left = sum(len(shard.rows) for shard in missing)
    bar = tqdm(total=total, initial=total - left, desc=description, unit="view", disable=not progress, smoothing=0.05)
    with bar, closing(_run(missing, config)) as results:  # an error here ends the workers
        for scene in scenes:
            if not scene.missing:
                yield scene.result()
        for shard, labelled in results:
            write_table(labelled.rows, shard.path)
            scene = scene_of_shard[shard]
            scene.missing.remove(shard)
            for step, seconds in labelled.seconds.items():
                scene.seconds[step] = scene.seconds.get(step, 0.0) + seconds
            bar.set_postfix_str(scene.task.name, refresh=False)
            bar.update(len(shard.rows))
            if not scene.missing:
                yield scene.result()


@dataclass(eq=False)
class _SceneInProgress:
    """A scene whose shards are being labelled; `missing` are those without a file yet."""

    task: LabelTask
    manifest: dict[str, Any]
    shards: list[Shard]
    missing: list[Shard]
    seconds: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, task: LabelTask, shard_size: int) -> _SceneInProgress:
        job = task.job
        table = task.table
        if table.empty:
            raise TableError("no viewpoints to label", value=task.name, fix="Run the sample stage with other settings.")
        device = job.device.partition(":")[0]
        settings: dict[str, Any] = {
            "versions": versions(),
            "localizer": job.localizer.record(),
            "extractor": job.extractor.record(),
            "camera": job.camera.record(),
            "renderer": f"{device} {method_on(device)}",  # which round some pixels differently
            "mesh": fingerprint(job.mesh),
            "landmarks": fingerprint(job.landmarks),
        }
        if job.localizer.method == "hypotheses":
            settings["first"] = True  # shards of before lack these labels
        if device != "cpu":
            settings["poses"] = "batched"  # `BatchedEstimator`
        if job.changed_mesh:
            settings["changed_mesh"] = fingerprint(job.changed_mesh)
        if job.cameras:
            settings["cameras"] = {number: camera.record() for number, camera in job.cameras}
        # only options that are set: the record decides the names of shards
        options = ("store_matches", "store_pixels", "appearance", "changes")
        settings |= {name: getattr(job, name) for name in options if getattr(job, name)}
        text = json.dumps(settings, sort_keys=True).encode()
        inputs = [name for name in (*SCHEMA.names, CAMERA_ID) if name not in LABELS and name in table]
        shards = []
        if job.on_gpu:  # in many batches, of which the first and last leave some steps idle
            shard_size = max(shard_size, 8192)
        elif job.device != "cpu":  # a batch is of one camera
            shard_size = max(shard_size, 16 * len(job.cameras))
        for begin in range(0, len(table), shard_size):
            rows = table.iloc[begin : begin + shard_size]
            content = pd.util.hash_pandas_object(rows[inputs], index=False).to_numpy()
            digest = hashlib.sha256(text + content.tobytes()).hexdigest()[:16]
            shards.append(Shard(job, task.shards / f"{begin:08d}-{digest}.parquet", rows))
        names = {shard.path.name: len(shard.rows) for shard in shards}
        manifest = {**settings, "n_viewpoints": len(table), "shards": names}
        write_json(task.shards / MANIFEST, manifest)
        return cls(task, manifest, shards, [shard for shard in shards if not _is_finished(shard)])

    def result(self) -> LabelledScene:
        table = pd.concat([_read(shard) for shard in self.shards], ignore_index=True)
        contents = {shard.path.name: {"n": len(shard.rows), "sha256": sha256(shard.path)} for shard in self.shards}
        return LabelledScene(self.task, table, {**self.manifest, "shards": contents}, self.seconds)


def _run(shards: Sequence[Shard], config: LabelConfig) -> Generator[tuple[Shard, LabelledShard], None, None]:
    if config.engine == "ray" and shards:
        yield from run_ray(shards, config.ray_address)
    elif shards:
        yield from run_local(shards, config.workers or max(shard.job.processes for shard in shards))


def _read(shard: Shard) -> pd.DataFrame:
    return read_table(shard.path, shard.job.store_matches, shard.job.store_pixels)


def _is_finished(shard: Shard) -> bool:
    """Whether a shard's file has the labels of its viewpoints; an unreadable one is removed."""
    try:
        return np.array_equal(_read(shard)["viewpoint_id"], shard.rows["viewpoint_id"])
    except TableError:
        shard.path.unlink(missing_ok=True)
        return False


def run_ray(shards: Sequence[Shard], address: str = "") -> Iterator[tuple[Shard, LabelledShard]]:
    """Label shards on a Ray cluster, each on one core and, with a CUDA device, a GPU or a sixteenth of one.

    They are begun in this order and yielded as they are finished. An empty address uses the cluster that this process
    is connected to, or starts one on this machine. Raises what a worker raises, ConfigError if Ray is not installed or
    the cluster cannot be used, WorkerError if a shard was lost more than five times.
    """
    require("ray")
    import ray

    connected = ray.is_initialized()
    try:
        if not connected:
            _connect(ray, address)
        _check_resources(ray, any(shard.job.device != "cpu" for shard in shards))
        yield from _run_on_ray(ray, shards)
    finally:
        if not connected:
            ray.shutdown()


def _connect(ray: Any, address: str) -> None:
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        if port.isdigit():  # fail soon if nothing listens: Ray itself tries for many minutes
            socket.create_connection((host, int(port)), timeout=10).close()
        dashboard = None if address else False
        ray.init(address or "local", log_to_driver=False, include_dashboard=dashboard, logging_level="ERROR")
    except (OSError, RuntimeError, ValueError, ImportError) as error:
        fix = "Start it (`ray start --head`), or correct label.ray_address."
        raise ConfigError(f"no Ray cluster there: {error}", value=address, fix=fix) from error


def _check_resources(ray: Any, needs_gpu: bool) -> None:
    """Raise ConfigError if the cluster lacks a CPU or GPU: Ray would wait for one silently."""
    resources = ray.cluster_resources()
    for name in ("CPU", "GPU") if needs_gpu else ("CPU",):
        if resources.get(name, 0) == 0:
            fix = "Add a machine that has one, or use --device cpu."
            raise ConfigError(f"the Ray cluster has no {name}", value=dict(resources), fix=fix)


def _run_on_ray(ray: Any, shards: Sequence[Shard]) -> Iterator[tuple[Shard, LabelledShard]]:
    waiting = iter(shards)
    running = dict[Any, Shard]()
    files = dict[SceneJob, Any]()
    label = ray.remote(num_cpus=1, max_retries=5)(_label_shard)

    def start(shard: Shard) -> None:
        if shard.job not in files:  # a scene travels to a machine once
            files.clear()
            files[shard.job] = ray.put([path.read_bytes() for path in _files(shard.job).values()])
        gpus = 1 if shard.job.on_gpu else 1 / 16  # several share the GPU where most steps run on cores
        if shard.job.device == "cpu":
            gpus = 0
        running[label.options(num_gpus=gpus).remote(shard.job, files[shard.job], shard.rows)] = shard

    try:
        while True:
            n_cores = int(ray.cluster_resources().get("CPU", 1))  # the cluster may grow and shrink
            for shard in islice(waiting, max(0, 2 * max(1, n_cores) - len(running))):
                start(shard)
            if not running:
                return
            (done, *_), _ = ray.wait(list(running))
            shard = running.pop(done)
            try:
                yield shard, ray.get(done)
            except ray.exceptions.RayError as error:
                cause = getattr(error, "cause", None)
                if isinstance(cause, WhereToLookError):
                    raise cause from None
                problem = f"labelling failed: {cause or error}"
                raise WorkerError(problem, path=shard.job.mesh, fix="Fix the cause and run again.") from error
    finally:  # otherwise a cluster that outlives this run would finish the tasks
        for unfinished in running:
            ray.cancel(unfinished)


def _files(job: SceneJob) -> dict[str, Path]:
    """Return the files of a scene by the names of their fields."""
    files = {"mesh": job.mesh, "landmarks": job.landmarks, "changed_mesh": job.changed_mesh}
    return {name: path for name, path in files.items() if path}


_worker: ShardWorker | None = None


def _label_shard(job: SceneJob, files: Sequence[bytes], rows: pd.DataFrame) -> LabelledShard:
    """Label a shard on a machine of the cluster, which caches the scene's files by their checksums."""
    global _worker
    if _worker is None:
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        _worker = ShardWorker()
    if job.device != "cpu":
        job = replace(job, device="cuda")  # the only GPU that Ray shows to this task
    paths = _files(job)
    copies = [_cached_file(content, path.suffix) for content, path in zip(files, paths.values(), strict=True)]
    local: dict[str, Any] = dict(zip(paths, copies, strict=True))
    try:
        return _worker.label(replace(job, **local), rows)
    except WhereToLookError as error:  # name the user's files, not the copies
        path = dict(zip(copies, paths.values(), strict=True)).get(Path(error.path or ""), error.path)
        raise type(error)(error.problem, path=path, value=error.value, fix=error.fix) from error


def _cached_file(content: bytes, suffix: str) -> Path:
    """Write content to a temporary file named by its checksum, unless it exists."""
    folder = Path(tempfile.gettempdir()) / f"wheretolook-{getattr(os, 'getuid', getpass.getuser)()}"
    path = folder / f"{hashlib.sha256(content).hexdigest()[:32]}{suffix}"
    if not path.is_file():
        partial = path.with_name(f"{path.name}.{os.getpid()}.partial")  # other workers may write the same file
        with atomic_write(path, partial):
            partial.write_bytes(content)
    return path
