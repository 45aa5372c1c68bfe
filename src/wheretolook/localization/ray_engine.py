"""The Ray engine: labels the same shards on a cluster of machines.

Machines need not share a file system: meshes and landmarks travel through Ray's object store, and labels come back to
the driver, which writes them. Ray restarts the shards of a lost machine on another one.
"""

from __future__ import annotations

import getpass
import hashlib
import os
import socket
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import pandas as pd

from wheretolook.localization.shard import LabelledShard, SceneJob, Shard, ShardWorker
from wheretolook.utils.errors import ConfigError, WhereToLookError, WorkerError
from wheretolook.utils.extras import require
from wheretolook.utils.files import atomic_write

MAX_RETRIES = 5
"""Restarts of a shard whose process or machine was lost."""

WORKERS_PER_GPU = 16


def run_ray(shards: Sequence[Shard], address: str = "") -> Iterator[tuple[Shard, LabelledShard]]:
    """Label shards on a Ray cluster, each on one core and, with a CUDA device, `1 / WORKERS_PER_GPU` of a GPU.

    They are begun in this order and yielded as they are finished. An empty address uses the cluster that this process
    is connected to, or starts one on this machine. Raises what a worker raises, ConfigError if Ray is not installed or
    the cluster cannot be used, WorkerError if a shard was lost more than `MAX_RETRIES` times.
    """
    require("ray")
    import ray

    connected = ray.is_initialized()
    try:
        if not connected:
            _connect(ray, address)
        _check_resources(ray, any(shard.job.device != "cpu" for shard in shards))
        yield from _run(ray, shards)
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


def _run(ray: Any, shards: Sequence[Shard]) -> Iterator[tuple[Shard, LabelledShard]]:
    waiting = iter(shards)
    running = dict[Any, Shard]()
    files = dict[SceneJob, Any]()
    label = ray.remote(num_cpus=1, max_retries=MAX_RETRIES)(_label_shard)

    def start(shard: Shard) -> None:
        if shard.job not in files:  # a scene travels to a machine once
            files.clear()
            files[shard.job] = ray.put([path.read_bytes() for path in _files(shard.job).values()])
        gpus = 1 / WORKERS_PER_GPU if shard.job.device != "cpu" else 0
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
