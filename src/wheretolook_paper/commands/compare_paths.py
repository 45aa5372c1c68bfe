"""`wheretolook compare-paths`: paths of several methods, rendered and localized, in `<dataset>/results/paths/`; resumes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
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
from wheretolook.scorers.registry import is_probability
from wheretolook.tracking import TrackingConfig, check_store
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook_paper.paths.config import PathsConfig

if TYPE_CHECKING:
    import pandas as pd

    from wheretolook_paper.paths.scene_comparison import SceneComparison


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
        from wheretolook_paper.paths.scene_comparison import compare_scenes, report_paths

        with reading(self.root, "compare-paths", "paths"):
            dataset = load_dataset(self, "map")
            compared = compare_scenes(self._comparisons(dataset, log), self.label)
            summary = report_paths(compared, dataset, self.paths, self.tracking, log)
        progress(1)
        return summary

    def _comparisons(self, dataset: Dataset, log: Log) -> list[SceneComparison]:
        from wheretolook.localization.shard import SceneJob
        from wheretolook.planning.scene_map import check_methods
        from wheretolook.scorers.weights import resolve_weights
        from wheretolook_paper.paths.scene_comparison import SceneComparison

        config = self.paths
        check_methods(config.methods)
        if config.stops.looks > 1 and not any(map(is_probability, config.methods)):
            raise ConfigError("stops need a method whose scores are probabilities", value=config.methods)
        check_store(self.tracking)
        scenes = scenes_with_meshes(dataset, config.in_scenes)
        weights = {name: resolve_weights(name, config.weights, dataset=dataset, log=log) for name in config.methods}
        comparisons = []
        for files in scenes:
            scene = open_scene(self, files)
            extractor = extractor_of(files, self.extractor)
            job = SceneJob(
                files.mesh,
                files.landmarks,
                scene.camera,
                self.label.localizer,
                extractor,
                scene.device,
                appearance=self.label.appearance,
            )
            folder = dataset.root / "results" / "paths" / scene.name
            comparisons.append(SceneComparison(scene, folder, config, weights, job, log))
        return comparisons


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
