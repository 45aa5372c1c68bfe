"""The label stage: every viewpoint rendered and localized."""

from __future__ import annotations

import shutil
import time
from contextlib import closing
from dataclasses import asdict
from typing import TYPE_CHECKING

from wheretolook.config import Experiment
from wheretolook.dataset.folders import Dataset, SceneFolder
from wheretolook.dataset.stamps import forget_stamp, is_done, read_stamp, stage_key, write_stamp
from wheretolook.stages.inputs import Say, Tick, dataset_after, existing, extractor_of
from wheretolook.utils.errors import MapError, SceneError
from wheretolook.utils.files import write_json
from wheretolook.viewpoints.table import write_table

if TYPE_CHECKING:
    import pandas as pd
from collections.abc import Mapping

import pandas as pd

from wheretolook.labelling.report import LABELS_CSV, LABELS_MD, LABELS_PNG, LabelSummary, label_markdown, label_summary
from wheretolook.utils.errors import TableError
from wheretolook.utils.files import write_text
from wheretolook.utils.tracking import TrackingConfig, log, start_run
from wheretolook.viewpoints.table import is_good
from wheretolook.viewpoints.thresholds import ALL


def label(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Dataset:
    """Stage 4: every viewpoint rendered and localized; status and errors into `<scene>/viewpoints.parquet`.

    Resumes after an interruption, see `wheretolook.labelling.labeller.label_scenes`. How the labels came out goes to
    `<dataset>/results/labels.*` and an MLflow run.

    Raises:
        SceneError: a mesh is missing, or a scene is known from photographs alone.
    """
    from wheretolook.labelling.labeller import LabelTask, label_scenes, storing
    from wheretolook.labelling.report import LABELS_MD
    from wheretolook.labelling.shard import SceneJob
    from wheretolook.stages.photographs import refuse_labelling
    from wheretolook.viewpoints.table import is_good

    def report(scene: SceneFolder, table: pd.DataFrame) -> None:
        say(f"{scene.name}: {is_good(table).mean():.0%} of {len(table):,} viewpoints localize within 5 cm and 0.4 "
            f"degrees -> {scene.table}")  # fmt: skip
        tick(1)

    dataset, config = dataset_after(experiment, "sample"), experiment.label
    scenes: dict[str, tuple[SceneFolder, str]] = {}
    tasks: list[LabelTask] = []
    for scene in dataset.scenes:
        refuse_labelling(scene)
    for scene in sorted(dataset.scenes, key=lambda scene: scene.split == "train"):  # those to evaluate on come first
        table, extractor = scene.read_table(), extractor_of(scene)
        key = stage_key("label", [asdict(config.localizer), asdict(extractor), asdict(dataset.camera),
                             existing(scene.mesh, SceneError, "scenes"),
                             existing(scene.landmarks, MapError, "map"), read_stamp(scene, "sample"),
                             *(["store_matches"] if config.store_matches else [])])  # fmt: skip
        shards = scene.folder / "shards"
        if is_done(scene, "label", key, scene.table):
            shutil.rmtree(shards, ignore_errors=True)  # killed before it could remove them
            report(scene, table)
            continue
        scenes[scene.name] = scene, key
        job = SceneJob(scene.mesh, scene.landmarks, dataset.camera, config.localizer, extractor, experiment.warp_device,
                       config.store_matches)  # fmt: skip
        tasks.append(LabelTask(scene.name, job, table, shards))
    summary = dataset.root / "results" / LABELS_MD
    seconds: dict[str, float] = {}
    start, replacing = time.monotonic(), False
    with closing(label_scenes(tasks, config, progress=bool(tasks))) as results:  # so that Ctrl-C here ends the workers
        for labelled in results:
            scene, key = scenes[labelled.task.name]
            if not replacing:  # until all are labelled alike, and that is logged, nothing may use the labels
                replacing = True
                summary.unlink(missing_ok=True)
                for other, _ in scenes.values():
                    forget_stamp(other, "label")
            with storing(scene.table):
                write_table(labelled.table, scene.table)
                write_json(scene.label_manifest, labelled.manifest)
                write_stamp(scene, "label", key)
            shutil.rmtree(labelled.task.shards, ignore_errors=True)
            for step, spent in labelled.seconds.items():
                seconds[step] = seconds.get(step, 0.0) + spent
            report(scene, labelled.table)
    if tasks:
        seconds["wall"] = time.monotonic() - start
    if not summary.is_file():
        try:
            log_labels(dataset, experiment.tracking, seconds)
        except BaseException:
            summary.unlink(missing_ok=True)
            raise
    if tasks:
        say("seconds: " + ", ".join(f"{step} {spent:.1f}" for step, spent in seconds.items())
            + " (workers' time in each step, added up; then the clock's)")  # fmt: skip
    return dataset


def log_labels(
    dataset: Dataset, tracking: TrackingConfig = TrackingConfig(), seconds: Mapping[str, float] | None = None
) -> LabelSummary:
    """Summarize the labels of a dataset, write `<dataset>/results/labels.csv`, `.md` and `.png`, and log an MLflow run.

    The run is of stage "label"; its metrics are the numbers of `LabelSummary.shares` over all scenes and, with the
    split's name in front, over each split.

    Args:
        dataset: labelled scenes.
        tracking: where to log.
        seconds: how long each stage took, by its name, logged as metrics `seconds_<name>`.

    Raises:
        TableError: there is no scene, a scene has no viewpoints, or one of them has no label.
    """
    from wheretolook.figures.labels import label_figure
    from wheretolook.figures.style import save_figure

    if not dataset.scenes:
        raise TableError("the dataset has no scene", path=dataset.root, fix="Run the scenes stage.")
    tables = {scene.name: _labelled_table(scene) for scene in dataset.scenes}
    summary = label_summary(tables, {scene.name: scene.split for scene in dataset.scenes})
    folder = dataset.root / "results"
    markdown = label_markdown(summary, f"Labels of {dataset.name}")
    for name, text in ((LABELS_CSV, summary.shares.to_csv(index=False)), (LABELS_MD, markdown)):
        write_text(folder / name, text)
    save_figure(label_figure(summary), folder / LABELS_PNG)

    params = {
        "dataset": dataset.name,
        "dataset_fingerprint": dataset.fingerprint(),
        "scenes": " ".join(scene.name for scene in dataset.scenes),
    }
    metrics = {f"seconds_{name}": value for name, value in (seconds or {}).items()}
    for row in summary.shares[summary.shares["scene"] == ALL].to_dict("records"):
        prefix = "" if row["split"] == ALL else f"{row['split']}_"
        metrics |= {f"{prefix}{name}": value for name, value in row.items() if name not in ("scene", "split")}
    with start_run(tracking, f"label {dataset.name}", "label", params, tags={"dataset": dataset.name}) as (client, run):
        log(client, run, metrics=metrics)
        for name in (LABELS_CSV, LABELS_MD, LABELS_PNG):
            client.log_artifact(run, str(folder / name))
    return summary


def _labelled_table(scene: SceneFolder) -> pd.DataFrame:
    table = scene.read_table()
    if table.empty:
        raise TableError("the table has no viewpoints", path=scene.table, fix="Run the sample stage again.")
    try:
        is_good(table)
    except TableError as error:
        raise TableError(error.problem, path=scene.table, value=error.value, fix=error.fix) from None
    return table
