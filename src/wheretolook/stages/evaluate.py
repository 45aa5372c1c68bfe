"""The evaluate stage: score the viewpoints of the test scenes with every method, tabulate, draw and log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from wheretolook.config import Experiment
from wheretolook.dataset.dataset_lock import reading, reads_dataset
from wheretolook.dataset.layout import Dataset
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.stages.holdout_photos import check_name, knows_photographs, leave_photographs_out
from wheretolook.stages.preconditions import Say, Tick, dataset_after, open_scene
from wheretolook.tracking.config import TrackingConfig
from wheretolook.tracking.store import check_store, kept_if_not_logged
from wheretolook.utils.errors import MapError
from wheretolook.utils.files import write_text
from wheretolook.visibility.config import OcclusionConfig
from wheretolook_paper.commands.look_sets import evaluate_looks

if TYPE_CHECKING:
    from wheretolook.evaluation.photographs import HeldOutPhotographs
    from wheretolook.training.provenance import TrainedModel


@reads_dataset("evaluate")
def evaluate(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> pd.DataFrame:
    """Stage 6: the score table of all methods on the test scenes, `<dataset>/results/`, and nested MLflow runs.

    Where labels keep where landmarks were matched, also `looks.csv` and `looks.md`: sets of looks localized together.
    """
    config = experiment.evaluate
    device = experiment.warp_device
    dataset = dataset_after(experiment, "label", knows_photographs if config.photographs else lambda scene: False)
    check_store(experiment.tracking)  # before the imports of what scores, which take seconds
    how: dict[str, Any] = {"device": device, "occlusion": experiment.occlusion}
    if config.photographs:
        how["photographs"] = _photographs(experiment, dataset, say)
    scores = evaluate_methods(dataset, config, experiment.tracking, **how)
    labelled = tuple(scene for scene in dataset.scenes if scene.stage_cache("label").stored_key is not None)
    if any(scene.split == config.split for scene in labelled):
        evaluate_looks(replace(dataset, scenes=labelled), config, experiment.tracking, device=device)
    tick(1)
    return scores


def _photographs(experiment: Experiment, dataset: Dataset, say: Say) -> list[HeldOutPhotographs]:
    """The photographs of the maps of a split's scenes, left out of them."""
    from wheretolook.holdout.holdout_views import evaluated_photographs
    from wheretolook.holdout.photo_map import says_metric

    found = []
    for files in dataset.split(experiment.evaluate.split):
        if knows_photographs(files):
            metric = experiment.map.photographs.assume_metric or not files.is_photographed or says_metric(files.map)
            name = check_name(experiment, files)
            keep_frame = files.mesh.is_file()
            how = (metric, keep_frame, None, None, say)
            source, left_out = leave_photographs_out(experiment, "evaluate", files.map, name, *how)
            hides = open_scene(experiment, dataset, files).occlusion
            found.append(evaluated_photographs(files, source, left_out, hides, experiment.warp_device))
    if not found:
        problem = "no scene of the split has a map whose photographs, or their features, are known"
        fix = "Map photographs (`wheretolook map --images`), or a model with its database or images."
        raise MapError(problem, path=dataset.root, value=experiment.evaluate.split, fix=fix)
    return found


def evaluate_methods(
    dataset: Dataset,
    config: EvaluateConfig = EvaluateConfig(),
    tracking: TrackingConfig = TrackingConfig(),
    models: Sequence[TrainedModel | Path] | None = None,
    progress: bool = True,
    device: str = "cpu",
    occlusion: OcclusionConfig = OcclusionConfig(),
    show: bool = True,
    photographs: Sequence[HeldOutPhotographs] = (),
) -> pd.DataFrame:
    """Compare all methods on the scenes of one split.

    Writes the table as `<dataset>/results/scores.csv` and `scores.md`, a figure `scores.png`, the reliability curves of
    learned methods as `calibration.csv`, and an MLflow run with one nested run for each method, occlusion model
    and candidate set, each with a table of what was chosen at each location for each N, `locations.parquet`. With
    several occlusion models `occlusion.png` compares them.

    The temperatures of learned methods are fitted on the labelled views of the val scenes, seen by the first occlusion
    model, and hold for all rows; without val scenes, or when these are evaluated, they are not known.

    The scenes need not be of the dataset the models were trained on. `models` are compared instead of those that
    `config.weights` tells; `photographs` that were left out of their maps are views, too, with rows of their own;
    `progress` shows a bar, and prints the table at the end unless `show` is off; `occlusion`
    has the settings of the models that `config.occlusions` names. Returns the tables of
    `wheretolook.evaluation.scores.score_table`, one below the other, with columns `occlusion` and `candidates`.

    Raises:
        TableError: there is no scene of the split, a viewpoint has no label, or all labels of a candidate set are of
            one class.
        WeightsError: weights are missing, or were trained for another field of view.
        MapError: a scene has no landmarks.
        ConfigError: the reference is none of the methods.
        InUseError: the dataset is being changed, or evaluated on the same split.
        TrackingError: the tracking store cannot be used. If it fails later, the results are kept, and a TrackingWarning
            says that they are not logged.
    """
    from wheretolook.evaluation.report import score_markdown
    from wheretolook.evaluation.results import log_evaluation, results_folder
    from wheretolook.evaluation.run import compare_methods

    title = f"Localization score on {dataset.name}" + (f", {config.split} scenes" if config.split != "test" else "")
    folder = results_folder(dataset, config)
    with reading(dataset.root, "evaluate", folder.name):
        check_store(tracking)
        found = compare_methods(dataset, config, models, progress, device, occlusion, photographs)
        write_results(folder, found.table, found.calibration, title)
        with kept_if_not_logged(f"the evaluation in {folder}", not_logged(dataset)):
            log_evaluation(dataset, found, config, tracking, occlusion, folder)
    if progress and show:
        print(score_markdown(found.table, title))
    return found.table


def not_logged(dataset: Dataset) -> Path:
    """A file that lies in a dataset's folder while its last evaluation is not logged."""
    return dataset.root / "evaluation_not_logged.json"


def write_results(folder: Path, table: pd.DataFrame, calibration: pd.DataFrame, title: str) -> None:
    """Write tables, report, calibration curves (if any) and figures; those of an earlier evaluation go."""
    from wheretolook.evaluation import results
    from wheretolook.evaluation.report import score_markdown
    from wheretolook.evaluation.scores import main_rows, read_scores
    from wheretolook.figures.calibration import calibration_figure
    from wheretolook.figures.scores import regret_figure, score_figure
    from wheretolook.figures.style import save_figure
    from wheretolook_paper.evaluation.paper_tables import write_paper_tables
    from wheretolook_paper.figures.occlusion import occlusion_figure

    write_text(folder / results.SCORES_CSV, table.to_csv(index=False))
    write_text(folder / results.SCORES_MD, score_markdown(table, title))
    variants = folder / results.VARIANTS_CSV
    papers = table
    if variants.is_file():  # the paper's tables have a row for each of the network's inputs, which a release knows
        others = main_rows(read_scores(variants))
        papers = pd.concat([table, others[~others["method"].isin(table["method"])]], ignore_index=True)
    write_paper_tables(papers, folder)
    save_figure(score_figure(table), folder / results.SCORES_PNG)
    save_figure(regret_figure(table), folder / results.REGRET_PNG)
    for name in (results.OCCLUSION_PNG, results.CALIBRATION_CSV, results.CALIBRATION_PNG):
        (folder / name).unlink(missing_ok=True)
    if table["occlusion"].nunique() > 1:
        save_figure(occlusion_figure(table), folder / results.OCCLUSION_PNG)
    if len(calibration):
        write_text(folder / results.CALIBRATION_CSV, calibration.to_csv(index=False))
        save_figure(calibration_figure(calibration), folder / results.CALIBRATION_PNG)
