"""`wheretolook evaluate`: viewpoints of the test scenes scored by every method, tabulated, drawn and logged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from wheretolook.commands.check import check_name, hold_out_photographs, knows_photographs
from wheretolook.commands.options import (
    LabelOptions,
    Log,
    Progress,
    SceneOptions,
    ignore_progress,
    load_dataset,
    open_scene,
)
from wheretolook.dataset.dataset_lock import reading, reads_dataset
from wheretolook.dataset.layout import Dataset
from wheretolook.evaluation.config import CALIBRATION_CSV, SCORES_CSV, EvaluateConfig, results_folder
from wheretolook.scorers.registry import describe_methods
from wheretolook.tracking import TrackingConfig, check_store, kept_if_not_logged
from wheretolook.utils.errors import MapError
from wheretolook.utils.files import write_text
from wheretolook.utils.package import reports
from wheretolook.visibility.config import OcclusionConfig

if TYPE_CHECKING:
    import pandas as pd

    from wheretolook.evaluation.scoring import HeldOutPhotographs
    from wheretolook.training.provenance import TrainedModel


@dataclass(frozen=True, kw_only=True)
class Evaluate(SceneOptions, LabelOptions):
    """Score all methods on the test scenes.

    Examples:
      wheretolook evaluate --config configs/demo.yaml --evaluate.methods '[random, visible, set]'
      wheretolook evaluate --list-methods

    Args:
        evaluate: which methods, on which views, and by which thresholds.
        tracking: where MLflow keeps its runs.
        list_methods: only list the methods that can be compared.
    """

    SHORT: ClassVar = {"engine": "label.engine"}
    LISTING: ClassVar = "list_methods"

    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    list_methods: bool = False

    def run(self, log: Log = print, progress: Progress = ignore_progress) -> pd.DataFrame | None:
        """Write the score table, `<dataset>/results/`, and nested MLflow runs; or list the methods.

        Installed packages add results of their own. Raises what `evaluate_methods` does.
        """
        if self.list_methods:
            list_methods()
            return None
        return self._evaluate(log, progress)

    @reads_dataset("evaluate")
    def _evaluate(self, log: Log, progress: Progress) -> pd.DataFrame:
        config = self.evaluate
        dataset = load_dataset(self, "label", knows_photographs if config.photographs else lambda scene: False)
        check_store(self.tracking)  # before imports that take seconds
        photographs = held_out_photographs(self, dataset, log) if config.photographs else ()
        scores = evaluate_methods(
            dataset, config, self.tracking, device=self.warp_device, occlusion=self.occlusion, photographs=photographs
        )
        for report in reports("look_sets"):
            report(dataset, config, self.tracking, self.warp_device)
        progress(1)
        return scores


def list_methods() -> None:
    """Print the methods that can be compared."""
    texts = describe_methods()
    width = max(map(len, texts))
    print("\n".join(f"{name:<{width}}  {text}" for name, text in texts.items()))


def held_out_photographs(options: Evaluate, dataset: Dataset, log: Log) -> list[HeldOutPhotographs]:
    """Hold the photographs of the maps of a split's scenes out of these maps."""
    from wheretolook.holdout.scores import evaluated_photographs

    held_out = []
    for files in filter(knows_photographs, dataset.split(options.evaluate.split)):
        log(f"{files.name}: holding out blocks of photographs")
        source, views = hold_out_photographs(options, "evaluate", files.map, check_name(options, files))
        occlusion = open_scene(options, files).occlusion
        held_out.append(evaluated_photographs(files, source, views, occlusion, options.warp_device))
    if not held_out:
        problem = "no scene of the split has a map whose photographs, or their features, are known"
        fix = "Map photographs (`wheretolook map --images`), or a model with its database or images."
        raise MapError(problem, path=dataset.root, value=options.evaluate.split, fix=fix)
    return held_out


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

    Writes the table as `<dataset>/results/scores.csv`, the reliability curves of learned methods as `calibration.csv`,
    the reports of installed packages, and an MLflow run with one nested run for each method, occlusion model and
    candidate set, each with a table of what was chosen at each location for each N, `locations.parquet`.

    The temperatures of learned methods are fitted on the labelled views of the val scenes, seen by the first occlusion
    model, and hold for all rows; without val scenes, or when these are evaluated, they are unknown.

    The scenes need not be of the dataset the models were trained on. `models` replace `config.weights`; `photographs`
    that were held out of their maps are further views, with separate rows; `progress` shows a bar, and prints the reports
    at the end unless `show` is off; `occlusion` has the settings of the models that `config.occlusions` names. Returns
    the tables of
    `wheretolook.evaluation.results.score_table`, one below the other, with columns `occlusion` and `candidates`.

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
    from wheretolook.evaluation.results import best_in_words, log_evaluation
    from wheretolook.evaluation.scoring import compare_methods

    title = f"Localization score on {dataset.name}" + (f", {config.split} scenes" if config.split != "test" else "")
    folder = results_folder(dataset, config)
    with reading(dataset.root, "evaluate", folder.name):
        check_store(tracking)
        found = compare_methods(dataset, config, models, progress, device, occlusion, photographs)
        texts = write_results(folder, found.table, found.calibration, title)
        with kept_if_not_logged(f"the evaluation in {folder}", not_logged(dataset)):
            log_evaluation(dataset, found, config, tracking, occlusion, folder)
    if progress and show:
        print("\n".join(texts) or best_in_words(found.table))
    return found.table


def not_logged(dataset: Dataset) -> Path:
    """Return the file that exists until a dataset's last evaluation is logged."""
    return dataset.root / "evaluation_not_logged.json"


def write_results(folder: Path, table: pd.DataFrame, calibration: pd.DataFrame, title: str) -> list[str]:
    """Write tables, calibration curves (if any) and the reports of installed packages; return the reports' texts.

    The curves of an earlier evaluation are removed.
    """
    write_text(folder / SCORES_CSV, table.to_csv(index=False))
    (folder / CALIBRATION_CSV).unlink(missing_ok=True)
    if len(calibration):
        write_text(folder / CALIBRATION_CSV, calibration.to_csv(index=False))
    return [report(folder, table, calibration, title) for report in reports("evaluate")]
