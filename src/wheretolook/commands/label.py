"""`wheretolook label`: every viewpoint rendered and localized."""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from wheretolook.commands.options import (
    LabelOptions,
    Log,
    Progress,
    ScenesConfig,
    existing,
    extractor_of,
    ignore_progress,
    load_dataset,
    naming_file,
    scene_job,
    select_options,
)
from wheretolook.commands.scenes import Scenes
from wheretolook.dataset.config import ALL
from wheretolook.dataset.dataset_lock import changes_dataset
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.features.extractor import ExtractorConfig
from wheretolook.localization.confidence import RIGHT_PLACE_LIMITS
from wheretolook.tracking import TrackingConfig, check_store, kept_if_not_logged, log as log_to_run, start_run
from wheretolook.utils.errors import MapError, SceneError, TableError
from wheretolook.utils.files import cache_key, read_json_object, write_json, write_text
from wheretolook.utils.package import reports

if TYPE_CHECKING:
    import pandas as pd


LABELS_CSV = "labels.csv"  # in `<dataset>/results/`: `label_shares`


@dataclass(frozen=True, kw_only=True)
class Label(LabelOptions):
    """Render and localize every viewpoint, measure the pose error. Resumes.

    Examples:
      wheretolook label --config configs/paper.yaml --engine ray

    Args:
        extractor: where the weights of the map's extractor are, if they have moved since it was made.
        scenes: the generated scenes that `label.changes` changes, as for the scenes command.
        tracking: where MLflow keeps its runs.
    """

    SHORT: ClassVar = {"engine": "label.engine"}
    GROUPS: ClassVar = {"extractor": "mapping.extractor."}

    extractor: ExtractorConfig = field(default_factory=ExtractorConfig)
    scenes: ScenesConfig = field(default_factory=ScenesConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)

    @changes_dataset("label")
    def run(self, log: Log = print, progress: Progress = ignore_progress) -> Dataset:
        """Write status and errors of every viewpoint into `<scene>/viewpoints.parquet`, a summary and an MLflow run.

        Resumes after an interruption, see `wheretolook.localization.labeller.label_scenes`. The summary is
        `<dataset>/results/labels.*`. Raises SceneError if a mesh is missing, or a scene is known from photographs alone.
        """
        dataset = load_dataset(self, "sample")
        for files in dataset.scenes:
            if files.is_photographed:
                problem = "without a mesh, viewpoints of a scene of photographs cannot be rendered and labelled"
                fix = "Score its viewpoints with weights trained elsewhere, or use a scene with a mesh."
                raise SceneError(problem, path=files.folder, fix=fix)
        to_label: dict[SceneFolder, str] = {}
        for files in sorted(dataset.scenes, key=lambda files: files.split == "train"):  # val and test scenes first
            key = self._key(files)
            if files.stage_cache("label", key).is_current(files.table):
                shutil.rmtree(_shards(files), ignore_errors=True)
                _report(files, files.read_table(), log)
                progress(1)
            else:
                to_label[files] = key
        summary = dataset.root / "results" / LABELS_CSV
        to_log = bool(to_label) or not summary.is_file() or _not_logged(dataset).is_file()
        if to_log:
            check_store(self.tracking)
        seconds = self._label(to_label, summary, log, progress) if to_label else {}
        if to_log:
            log_labels(dataset, self.tracking, seconds)
        return dataset

    def _key(self, files: SceneFolder) -> str:
        extractor = extractor_of(files, self.extractor)
        settings = [self.label.localizer.record(), extractor.record(), files.camera.record()]
        made_from = [existing(files.mesh, SceneError, "scenes"), existing(files.landmarks, MapError, "map")]
        changes = [name for name in ("store_matches", "store_pixels") if getattr(self.label, name)]
        changes += [f"{name} {value}" for name in ("appearance", "changes") if (value := getattr(self.label, name))]
        return cache_key("label", [*settings, *made_from, files.stage_cache("sample").stored_key, *changes])

    def _label(
        self, to_label: Mapping[SceneFolder, str], summary: Path, log: Log, progress: Progress
    ) -> dict[str, float]:
        """Label scenes and store their keys. Returns the seconds that each step took."""
        from wheretolook.dataset.viewpoint_files import write_table
        from wheretolook.localization.labeller import LabelTask, label_scenes

        config = self.label
        scenes = {files.name: files for files in to_label}
        tasks = []
        for files in to_label:
            job = scene_job(files, config, extractor_of(files, self.extractor), self.warp_device)
            job = replace(job, store_matches=config.store_matches, store_pixels=config.store_pixels)
            if config.changes:
                changed_mesh = select_options(Scenes, self).change(files, config.changes)
                job = replace(job, changes=config.changes, changed_mesh=changed_mesh)
            tasks.append(LabelTask(files.name, job, files.read_table(), _shards(files)))
        seconds = Counter[str]()
        start = time.monotonic()
        with closing(label_scenes(tasks, config)) as results:  # an interrupt here ends the workers
            for number, labelled in enumerate(results):
                files = scenes[labelled.task.name]
                if number == 0:  # labels are unusable until all scenes have the new ones, and these are logged
                    summary.unlink(missing_ok=True)
                    for other in to_label:
                        other.stage_cache("label").clear()
                write_table(labelled.table, files.table)
                write_json(files.label_manifest, labelled.manifest)
                files.stage_cache("label", to_label[files]).store()
                shutil.rmtree(labelled.task.shards, ignore_errors=True)
                shutil.rmtree(files.adapt_shards, ignore_errors=True)
                seconds.update(labelled.seconds)  # type: ignore[call-overload]
                _report(files, labelled.table, log)
                progress(1)
        wall = time.monotonic() - start
        total = sum(seconds.values()) or 1.0
        workers = config.workers or max(task.job.processes for task in tasks)
        times = ", ".join(
            f"{step} {spent:.1f} ({spent / total:.0%}, alone {spent / workers:.1f})" for step, spent in seconds.items()
        )
        log(f"seconds over workers (share, wall time of this step alone): {times}; wall {wall:.1f}")
        return {**seconds, "wall": wall}


def _shards(files: SceneFolder) -> Path:
    return files.folder / "shards"


def _report(files: SceneFolder, table: pd.DataFrame, log: Log) -> None:
    from wheretolook.dataset.viewpoint_table import has_first, is_good, with_first_labels

    text = f"{is_good(table).mean():.0%} of {len(table):,} viewpoints localize within 5 cm and 0.4 degrees"
    if has_first(table):
        first = with_first_labels(table)
        limit_m, limit_deg = RIGHT_PLACE_LIMITS
        near, near_first = (is_good(labels, limit_m, limit_deg).mean() for labels in (table, first))
        text += f" ({is_good(first).mean():.0%} by the first RANSAC result), "
        text += f"{near:.0%} ({near_first:.0%}) at the right place"
    log(f"{files.name}: {text} -> {files.table}")


def log_labels(
    dataset: Dataset, tracking: TrackingConfig = TrackingConfig(), seconds: Mapping[str, float] | None = None
) -> pd.DataFrame:
    """Summarize the labels of a dataset, write `<dataset>/results/labels.csv` and reports, and log an MLflow run.

    Returns `label_shares`. The run's metrics are their numbers over all scenes and, prefixed with the split's name, over
    each split, and the seconds that each step took, `seconds_<name>`. Raises TableError if there is no scene, a scene
    has no viewpoints, or one of them has no label. If the run cannot be logged, the files are kept with the seconds,
    and a TrackingWarning announces that a later call logs it.
    """
    from wheretolook.dataset.viewpoint_table import label_shares, pooled_labels

    if not dataset.scenes:
        raise TableError("the dataset has no scene", path=dataset.root, fix="Run `wheretolook scenes`.")
    tables = {scene.name: _labelled_table(scene) for scene in dataset.scenes}
    views = pooled_labels(tables, {scene.name: scene.split for scene in dataset.scenes})
    shares = label_shares(views)
    folder = dataset.root / "results"
    note = _not_logged(dataset)
    if not seconds:
        with suppress(OSError, ValueError):
            seconds = read_json_object(note)
    metrics = {f"seconds_{name}": value for name, value in (seconds or {}).items()}
    for row in shares[shares["scene"] == ALL].to_dict("records"):
        prefix = "" if row["split"] == ALL else f"{row['split']}_"
        metrics |= {f"{prefix}{name}": value for name, value in row.items() if name not in ("scene", "split")}
    params = {"dataset": dataset.name, "dataset_fingerprint": dataset.fingerprint(), "scenes": " ".join(tables)}
    with kept_if_not_logged(f"the summary of labels in {folder}", note, seconds or {}):
        written = [path for report in reports("label") for path in report(folder, views, f"Labels of {dataset.name}")]
        write_text(folder / LABELS_CSV, shares.to_csv(index=False))  # the last file: where it is, nothing is missing
        with start_run(tracking, "all scenes", "label", params, tags={"dataset": dataset.name}) as (client, run):
            log_to_run(client, run, metrics=metrics, files=(folder / LABELS_CSV, *written))
    return shares


def _not_logged(dataset: Dataset) -> Path:
    """Return the file with the seconds of each step that exists until the dataset's labels are logged."""
    return dataset.root / "labels_not_logged.json"


def _labelled_table(scene: SceneFolder) -> pd.DataFrame:
    from wheretolook.dataset.viewpoint_table import is_good

    table = scene.read_table()
    with naming_file(scene.table):
        if table.empty:
            raise TableError("the table has no viewpoints", fix="Run `wheretolook sample` again.")
        is_good(table)
    return table
