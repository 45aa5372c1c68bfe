"""The Ray engine: labels the same shards on a cluster of machines.

Machines need not share a file system: meshes and landmarks travel through Ray's object store, and labels come back to
the driver, which writes them. Ray restarts the shards of a machine that is removed on another one.
"""

from __future__ import annotations

import hashlib
import os
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import pandas as pd

from wheretolook.localization.shard import LabelledShard, SceneJob, Shard, ShardWorker
from wheretolook.utils.errors import ConfigError, WhereToLookError, WorkerError
from wheretolook.utils.files import atomic_write

MAX_RETRIES = 5
"""How often Ray restarts a shard whose process or machine was lost."""

KEEP_S = 24 * 3600.0
"""How many seconds a machine keeps meshes and landmarks that no shard uses."""

WORKERS_A_GPU = 16
"""Shards that share one GPU."""


def run_ray(
    shards: Sequence[Shard], address: str = "", tick: Callable[[int], None] = lambda n: None
) -> Iterator[tuple[Shard, LabelledShard]]:
    """Label shards on a Ray cluster, each on one core and, with device "cuda", `1 / WORKERS_A_GPU` of a GPU.

    They are begun in this order and yielded as they are finished. An empty address uses the cluster that this process
    is connected to, or starts one on this machine. `tick` is called with the number of viewpoints just finished.

    Raises what a worker raises; a ConfigError if Ray is not installed, or there is no cluster at the address; a
    WorkerError if a shard was lost more than `MAX_RETRIES` times.
    """
    try:
        import ray
    except ImportError as error:
        fix = "Install it: pip install ray, or use label.engine local."
        raise ConfigError("Ray is not installed", value="label.engine ray", fix=fix) from error
    ours = not ray.is_initialized()
    if ours:
        _connect(ray, address)
    try:
        yield from _run(ray, shards, tick)
    finally:
        if ours:
            ray.shutdown()


def _connect(ray: Any, address: str) -> None:
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        if port.isdigit():  # fail soon where nothing listens: Ray itself would try for many minutes
            socket.create_connection((host, int(port)), timeout=10).close()
        dashboard = None if address else False
        ray.init(address or "local", log_to_driver=False, include_dashboard=dashboard, logging_level="ERROR")
    except (OSError, RuntimeError, ValueError, ImportError) as error:
        fix = "Start it (`ray start --head`), or correct label.ray_address."
        raise ConfigError(f"no Ray cluster there: {error}", value=address, fix=fix) from error


def _check_resources(resources: Mapping[str, float], needs_gpu: bool) -> None:
    """Raise ConfigError if the cluster lacks a CPU or GPU: Ray would wait for one silently."""
    fixes = {"CPU": "Add a machine."}
    if needs_gpu:
        fixes["GPU"] = "Add a machine that has one, or give --device cpu."
    for name, fix in fixes.items():
        if resources.get(name, 0) == 0:
            raise ConfigError(f"the Ray cluster has no {name}", value=dict(resources), fix=fix)


def _run(ray: Any, shards: Sequence[Shard], tick: Callable[[int], None]) -> Iterator[tuple[Shard, LabelledShard]]:
    _check_resources(ray.cluster_resources(), any(shard.job.device != "cpu" for shard in shards))
    waiting = iter(shards)
    running = dict[Any, Shard]()
    files = dict[SceneJob, Any]()
    label = ray.remote(num_cpus=1, max_retries=MAX_RETRIES)(_label_shard)

    def start(shard: Shard) -> None:
        if shard.job not in files:  # a scene travels to a machine once
            files.clear()
            files[shard.job] = ray.put((shard.job.mesh.read_bytes(), shard.job.landmarks.read_bytes()))
        gpus = 1 / WORKERS_A_GPU if shard.job.device != "cpu" else 0
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
                labelled = ray.get(done)
            except ray.exceptions.RayTaskError as error:
                if isinstance(error.cause, WhereToLookError):
                    raise error.cause from None
                problem = f"labelling failed: {type(error.cause).__name__}: {error.cause}"
                fix = "Finished shards are kept: mend the cause and run again."
                raise WorkerError(problem, path=shard.job.mesh, fix=fix) from error
            except ray.exceptions.RayError as error:
                problem = f"a shard was lost more than {MAX_RETRIES} times: {error}"
                fix = "Finished shards are kept: mend the cluster and run again."
                raise WorkerError(problem, path=shard.job.mesh, fix=fix) from error
            tick(len(shard.rows))
            yield shard, labelled
    finally:  # otherwise a cluster that goes on after this run would finish the tasks
        for unfinished in running:
            ray.cancel(unfinished)


_worker: ShardWorker | None = None


def _label_shard(job: SceneJob, files: tuple[bytes, bytes], rows: pd.DataFrame) -> LabelledShard:
    """Label a shard, on a machine of the cluster, which keeps the scene's files under names made of their content."""
    global _worker
    if _worker is None:
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        _worker = ShardWorker()
    folder = Path(tempfile.gettempdir()) / f"wheretolook-{os.getuid()}"
    folder.mkdir(exist_ok=True)
    if job.device != "cpu":
        job = replace(job, device="cuda")  # the only one that Ray lets this task see
    mesh = _cached_file(folder, files[0], job.mesh.suffix)
    landmarks = _cached_file(folder, files[1], job.landmarks.suffix)
    try:
        return _worker.label(replace(job, mesh=mesh, landmarks=landmarks), rows)
    except WhereToLookError as error:  # name the user's files, not the copies
        path = {mesh: job.mesh, landmarks: job.landmarks}.get(Path(error.path or ""), error.path)
        raise type(error)(error.problem, path=path, value=error.value, fix=error.fix) from error


def _cached_file(folder: Path, content: bytes, suffix: str) -> Path:
    """File with the given content, written unless it is there; files that have not been used for long are removed."""
    path = folder / f"{hashlib.sha256(content).hexdigest()[:32]}{suffix}"
    try:
        os.utime(path)
    except FileNotFoundError:
        partial = path.with_name(f"{path.name}.{os.getpid()}.partial")  # other workers may write the same file
        with atomic_write(path, partial):
            partial.write_bytes(content)
        for file in folder.iterdir():
            with suppress(FileNotFoundError):  # another worker may have removed it
                if file.stat().st_mtime < time.time() - KEEP_S:
                    file.unlink()
    return path
