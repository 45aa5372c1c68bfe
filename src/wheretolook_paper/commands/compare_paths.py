"""`wheretolook compare-paths`: paths of several methods, rendered and localized, in `<dataset>/results/paths/`; resumes."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, ClassVar

from wheretolook.commands.options import (
    LabelOptions,
    Log,
    Progress,
    SceneOptions,
    extractor_of,
    ignore_progress,
    load_dataset,
    open_scene,
)
from wheretolook.dataset.dataset_lock import reading
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.tracking import TrackingConfig, check_store, kept_if_not_logged
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.utils.files import atomic_write, write_text
from wheretolook_paper.paths.config import PathsConfig

if TYPE_CHECKING:
    import pandas as pd

    from wheretolook_paper.paths.scene_comparison import SceneComparison

FOLDER = "paths"
"""In `results/`: a folder for each scene, and the views of all scenes."""


@dataclass(frozen=True, kw_only=True)
class ComparePaths(SceneOptions, LabelOptions):
    """Plan paths between random locations by several methods, render what the camera sees, localize it. Resumes.

    Examples:
      wheretolook compare-paths --config configs/demo.yaml --methods forward set --pairs 5

    Args:
        paths: which paths, and by which methods.
        tracking: where MLflow keeps its runs.
    """

    SHORT: ClassVar = {"engine": "label.engine", "stops": "stops.looks", "paths.scenes": "in_scenes"}
    GROUPS: ClassVar = {"paths": ""}

    paths: PathsConfig = field(default_factory=PathsConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)

    def run(self, log: Log = print, progress: Progress = ignore_progress) -> pd.DataFrame:
        """Plan paths by several methods, render and localize their views; write and log `<dataset>/results/paths.*`.

        Needs `map` only. Planned paths and labels of earlier runs are reused. With `paths.stops` and
        `paths.last_views`, views are also localized jointly. Returns the table of `summarize_paths`.

        Raises:
            ConfigError: no such scene or method, no weights, or no method that supports the requested stops.
            WeightsError: the weights cannot be used.
            SceneError: a scene has no mesh, or too little free space for starts and goals.
            TrackingError: the tracking store cannot be used.
        """
        import pandas as pd

        from wheretolook.localization.labeller import label_scenes
        from wheretolook.planning.scene_map import check_methods
        from wheretolook.scorers.registry import is_probability

        with reading(self.root, "compare-paths", FOLDER):
            dataset = load_dataset(self, "map")
            config = self.paths
            check_methods(config.methods)
            if config.stops.looks > 1 and not any(map(is_probability, config.methods)):
                raise ConfigError("stops need a method whose scores are probabilities", value=config.methods)
            check_store(self.tracking)
            scenes = _comparisons(self, dataset, log)
            tasks = [task for scene in scenes for task in scene.tasks()]
            with closing(label_scenes(tasks, self.label, description="localize")) as labelled:
                labels = {result.task.shards: result.table.reset_index(drop=True) for result in labelled}
            results = {one.scene.name: one.results(labels) for one in scenes}
            paths = pd.concat([found.paths.assign(scene=name) for name, found in results.items()], ignore_index=True)
            views = pd.concat([found.views.assign(scene=name) for name, found in results.items()], ignore_index=True)
            summary = _report(paths, views, dataset, config, self.tracking, log)
        progress(1)
        return summary


def scenes_with_meshes(dataset: Dataset, names: Sequence[str]) -> list[SceneFolder]:
    """Return the scenes of these names, by default the test scenes.

    Raises ConfigError if there is none, SceneError if one has no mesh.
    """
    scenes = [dataset.scene(name) for name in names] or list(dataset.split("test"))
    if not scenes:
        raise ConfigError("the dataset has no test scene", path=dataset.root, fix="Name scenes: --in-scenes.")
    for scene in scenes:
        if not scene.mesh.is_file():
            raise SceneError("rendering needs a mesh", path=scene.folder, fix="Choose other scenes.")
    return scenes


def _comparisons(options: ComparePaths, dataset: Dataset, log: Log) -> list[SceneComparison]:
    from wheretolook.localization.shard import SceneJob
    from wheretolook.scorers.weights import resolve_weights
    from wheretolook_paper.paths.scene_comparison import SceneComparison

    config = options.paths
    scenes = scenes_with_meshes(dataset, config.in_scenes)
    weights = {name: resolve_weights(name, config.weights, dataset=dataset, log=log) for name in config.methods}
    comparisons = []
    for files in scenes:
        scene = open_scene(options, files)
        extractor = extractor_of(files, options.extractor)
        label = options.label
        made_from = files.mesh, files.landmarks, scene.camera, label.localizer, extractor, scene.device
        job = SceneJob(*made_from, appearance=label.appearance)
        folder = dataset.root / "results" / FOLDER / scene.name
        comparisons.append(SceneComparison(scene, dataset, folder, config, weights, job, log))
    return comparisons


def _report(
    paths: pd.DataFrame, views: pd.DataFrame, dataset: Dataset, config: PathsConfig, tracking: TrackingConfig, log: Log
) -> pd.DataFrame:
    """Summarize the localized views, write tables and figure, and log them."""
    from wheretolook.figures.floor_plan import save_figure
    from wheretolook_paper.figures.paths import paths_figure
    from wheretolook_paper.paths import path_report as report

    summary = report.summarize_paths(paths, views, config)
    folder = dataset.root / "results"
    markdown = report.path_markdown(summary, config)
    write_text(folder / report.PATHS_CSV, summary.to_csv(index=False, float_format="%.6g", lineterminator="\n"))
    write_text(folder / report.PATHS_MD, markdown)
    with atomic_write(folder / FOLDER / "views.parquet") as partial:
        views.to_parquet(partial, index=False)
    save_figure(paths_figure(summary), folder / report.PATHS_PNG)
    params = {"dataset": dataset.name, "pairs": config.pairs, "seed": config.seed, "time_s": config.planner.time_s}
    params |= {"score_weight": config.planner.score_weight, "max_turn_deg": config.max_turn_deg}
    if config.stops.looks > 1:
        params |= {f"stops.{name}": value for name, value in asdict(config.stops).items()}
    if config.last_views > 1:
        params |= {"last_views": config.last_views}
        params |= {f"odometry_{unit}": getattr(config, f"odometry_{unit}") for unit in ("m_per_m", "deg_per_deg")}
    with kept_if_not_logged(f"the comparison in {folder}"):
        report.log_paths(params, summary, folder, tracking)
    log(markdown)
    log(f"-> {folder / report.PATHS_CSV}, {report.PATHS_MD}, {report.PATHS_PNG}; every view in {folder / FOLDER}")
    return summary
