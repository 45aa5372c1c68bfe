"""The label stage: every viewpoint rendered and localized."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

import pandas as pd

from wheretolook.config import Experiment
from wheretolook.dataset.dataset_lock import changes_dataset
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.thresholds import ALL
from wheretolook.dataset.viewpoint_table import is_good, write_table
from wheretolook.localization.report import (
    LABELS_CSV,
    LABELS_MD,
    LABELS_PNG,
    LabelSummary,
    label_markdown,
    label_summary,
)
from wheretolook.stages.preconditions import Say, Tick, dataset_after, existing, extractor_of, open_scene
from wheretolook.tracking.config import TrackingConfig
from wheretolook.tracking.runs import log, start_run
from wheretolook.tracking.store import check_store, kept_if_not_logged
from wheretolook.utils.artifact_cache import cache_key
from wheretolook.utils.errors import MapError, SceneError, TableError
from wheretolook.utils.files import write_json, write_text
from wheretolook.utils.reading import read_json_object


@changes_dataset("label")
def label(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Dataset:
    """Stage 4: every viewpoint rendered and localized; status and errors into `<scene>/viewpoints.parquet`.

    Resumes after an interruption, see `wheretolook.localization.labeller.label_scenes`. How the labels came out goes to
    `<dataset>/results/labels.*` and an MLflow run. Raises SceneError if a mesh is missing, or a scene is known from
    photographs alone.
    """
    dataset = dataset_after(experiment, "sample")
    config = experiment.label
    for files in dataset.scenes:
        if files.is_photographed:
            problem = "this scene is known from photographs alone: without a mesh its viewpoints cannot be rendered, "
            fix = "Score its viewpoints with weights trained elsewhere, or use a scene with a mesh."
            raise SceneError(f"{problem}and so not labelled", path=files.folder, fix=fix)
    to_label: list[tuple[SceneFolder, str]] = []
    for files in sorted(dataset.scenes, key=lambda files: files.split == "train"):  # those to evaluate on come first
        parts = [
            config.localizer.record(),
            extractor_of(files, experiment.map.extractor).record(),
            files.camera.record(),
        ]
        made_from = [existing(files.mesh, SceneError, "scenes"), existing(files.landmarks, MapError, "map")]
        matches = [name for name in ("store_matches", "store_pixels") if getattr(config, name)]
        key = cache_key("label", [*parts, *made_from, files.stage_cache("sample").stored_key, *matches])
        if files.stage_cache("label", key).is_current(files.table):
            shutil.rmtree(_shards(files), ignore_errors=True)  # killed before it could remove them
            _report(files, files.read_table(), say)
            tick(1)
        else:
            to_label.append((files, key))
    summary = dataset.root / "results" / LABELS_MD
    if to_label or not summary.is_file() or _not_logged(dataset).is_file():
        check_store(experiment.tracking)
    seconds = _label(experiment, dataset, to_label, say, tick) if to_label else {}
    if not summary.is_file() or _not_logged(dataset).is_file():
        log_labels(dataset, experiment.tracking, seconds)
    if to_label:
        times = ", ".join(f"{step} {spent:.1f}" for step, spent in seconds.items())
        say(f"seconds: {times} (workers' time in each step, added up; then the clock's)")
    return dataset


def _label(
    experiment: Experiment, dataset: Dataset, to_label: list[tuple[SceneFolder, str]], say: Say, tick: Tick
) -> dict[str, float]:
    """Label scenes and stamp them with their keys. Returns the seconds that each step took."""
    from wheretolook.localization.labeller import LabelTask, label_scenes
    from wheretolook.localization.shard import SceneJob

    config = experiment.label
    keys = {files.name: (files, key) for files, key in to_label}
    tasks: list[LabelTask] = []
    for files, _ in to_label:
        scene = open_scene(experiment, dataset, files)
        options = (config.localizer, extractor_of(files, experiment.map.extractor), scene.device, config.store_matches)
        cameras = tuple(files.cameras().items()) if files.cameras_file.is_file() else ()
        job = SceneJob(files.mesh, files.landmarks, scene.camera, *options, cameras, config.store_pixels)
        tasks.append(LabelTask(scene.name, job, files.read_table(), _shards(files)))
    seconds: dict[str, float] = {}
    start = time.monotonic()
    replacing = False
    with closing(label_scenes(tasks, config)) as results:  # so that Ctrl-C here ends the workers
        for labelled in results:
            files, key = keys[labelled.task.name]
            if not replacing:  # until all are labelled alike, and that is logged, nothing may use the labels
                replacing = True
                (dataset.root / "results" / LABELS_MD).unlink(missing_ok=True)
                for other, _ in to_label:
                    other.stage_cache("label").clear()
            write_table(labelled.table, files.table)
            write_json(files.label_manifest, labelled.manifest)
            files.stage_cache("label", key).store()
            shutil.rmtree(labelled.task.shards, ignore_errors=True)
            shutil.rmtree(files.adapt_shards, ignore_errors=True)  # a part of the same views
            for step, spent in labelled.seconds.items():
                seconds[step] = seconds.get(step, 0.0) + spent
            _report(files, labelled.table, say)
            tick(1)
    return {**seconds, "wall": time.monotonic() - start}


def _shards(files: SceneFolder) -> Path:
    return files.folder / "shards"


def _report(files: SceneFolder, table: pd.DataFrame, say: Say) -> None:
    good = f"{is_good(table).mean():.0%} of {len(table):,} viewpoints localize within 5 cm and 0.4 degrees"
    say(f"{files.name}: {good} -> {files.table}")


def log_labels(
    dataset: Dataset, tracking: TrackingConfig = TrackingConfig(), seconds: Mapping[str, float] | None = None
) -> LabelSummary:
    """Summarize the labels of a dataset, write `<dataset>/results/labels.csv`, `.md` and `.png`, and log an MLflow run.

    The run is of stage "label"; its metrics are the numbers of `LabelSummary.shares` over all scenes and, with the
    split's name in front, over each split, and the seconds that each step took, `seconds_<name>`. Raises TableError if
    there is no scene, a scene has no viewpoints, or one of them has no label. If the run cannot be logged, the files
    are kept with the seconds, and a TrackingWarning says that logging is left to a later call.
    """
    from wheretolook.figures.labels import label_figure
    from wheretolook.figures.style import save_figure

    if not dataset.scenes:
        raise TableError("the dataset has no scene", path=dataset.root, fix="Run the scenes stage.")
    tables = {scene.name: _labelled_table(scene) for scene in dataset.scenes}
    summary = label_summary(tables, {scene.name: scene.split for scene in dataset.scenes})
    folder = dataset.root / "results"
    note = _not_logged(dataset)
    if not seconds and note.is_file():
        seconds = _seconds_of(note)
    write_json(note, seconds or {})  # before the files, which are taken as logged without it
    write_text(folder / LABELS_CSV, summary.shares.to_csv(index=False))
    save_figure(label_figure(summary), folder / LABELS_PNG)
    write_text(folder / LABELS_MD, label_markdown(summary, f"Labels of {dataset.name}"))

    params = {"dataset": dataset.name, "dataset_fingerprint": dataset.fingerprint(), "scenes": " ".join(tables)}
    metrics = {f"seconds_{name}": value for name, value in (seconds or {}).items()}
    for row in summary.shares[summary.shares["scene"] == ALL].to_dict("records"):
        prefix = "" if row["split"] == ALL else f"{row['split']}_"
        metrics |= {f"{prefix}{name}": value for name, value in row.items() if name not in ("scene", "split")}
    opened = start_run(tracking, "all scenes", "label", params, tags={"dataset": dataset.name})
    with kept_if_not_logged(f"the summary of labels in {folder}", note, seconds or {}), opened as (client, run):
        log(client, run, metrics=metrics)
        for name in (LABELS_CSV, LABELS_MD, LABELS_PNG):
            client.log_artifact(run, str(folder / name))
    return summary


def _not_logged(dataset: Dataset) -> Path:
    """A file that lies in a dataset's folder while its labels are not logged: the seconds that each step took."""
    return dataset.root / "labels_not_logged.json"


def _seconds_of(note: Path) -> dict[str, float]:
    try:
        return {name: float(value) for name, value in read_json_object(note).items()}
    except (OSError, ValueError, TypeError):
        return {}  # damaged: only how long it took is lost


def _labelled_table(scene: SceneFolder) -> pd.DataFrame:
    table = scene.read_table()
    if table.empty:
        raise TableError("the table has no viewpoints", path=scene.table, fix="Run the sample stage again.")
    try:
        is_good(table)
    except TableError as error:
        raise TableError(error.problem, path=scene.table, value=error.value, fix=error.fix) from None
    return table
