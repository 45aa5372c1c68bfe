"""Labels tables of viewpoints in shards, so that interrupted work is resumed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from tqdm.auto import tqdm

from wheretolook.dataset.viewpoint_files import SCHEMA, read_table, write_table
from wheretolook.dataset.viewpoint_table import CAMERA_ID, LABELS
from wheretolook.localization.config import LabelConfig
from wheretolook.localization.shard import LabelledShard, SceneJob, Shard, run_local
from wheretolook.localization.versions import versions
from wheretolook.utils.errors import TableError
from wheretolook.utils.files import fingerprint, sha256, write_json
from wheretolook.utils.system import cores

MANIFEST = "manifest.json"
"""File in the folder of shards with the settings of the labels; later `labels.json` next to the table."""

MIN_VIEWS_PER_CAMERA = 16
"""Minimum mean number of views of each of several cameras in a shard on a GPU: a batch is of one camera."""


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
        settings: dict[str, Any] = {
            "versions": versions(),
            "localizer": job.localizer.record(),
            "extractor": job.extractor.record(),
            "camera": job.camera.record(),
            "renderer": _renderer_name(job.device),
            "mesh": fingerprint(job.mesh),
            "landmarks": fingerprint(job.landmarks),
        }
        if job.localizer.method == "hypotheses":
            settings["first"] = True  # shards of before lack these labels
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
        if job.device != "cpu":
            shard_size = max(shard_size, MIN_VIEWS_PER_CAMERA * len(job.cameras))
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


def _renderer_name(device: str) -> str:
    """Kind of device and rendering method, which round some pixels differently."""
    from wheretolook.rendering.warp_renderer import method_on

    kind = device.partition(":")[0]
    return f"{kind} {method_on(kind)}"


def _run(shards: Sequence[Shard], config: LabelConfig) -> Generator[tuple[Shard, LabelledShard], None, None]:
    if config.engine == "ray" and shards:
        from wheretolook.localization.ray_engine import run_ray

        yield from run_ray(shards, config.ray_address)
    elif shards:
        yield from run_local(shards, config.workers or cores())


def _read(shard: Shard) -> pd.DataFrame:
    return read_table(shard.path, shard.job.store_matches, shard.job.store_pixels)


def _is_finished(shard: Shard) -> bool:
    """Whether a shard's file has the labels of its viewpoints; an unreadable one is removed."""
    try:
        return np.array_equal(_read(shard)["viewpoint_id"], shard.rows["viewpoint_id"])
    except TableError:
        shard.path.unlink(missing_ok=True)
        return False
