"""`wheretolook relocalize`: a camera at an unknown pose turns until it is localized, in simulation; resumes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.commands.options import (
    Log,
    Progress,
    SceneOptions,
    extractor_of,
    ignore_progress,
    load_dataset,
    open_scene,
)
from wheretolook.dataset.dataset_lock import reading
from wheretolook.tracking import TrackingConfig, check_store
from wheretolook.utils.errors import check_choice, check_range, no_option
from wheretolook_paper.commands.compare_paths import scenes_with_meshes

if TYPE_CHECKING:
    import pandas as pd

    from wheretolook.dataset.layout import Dataset, SceneFolder
    from wheretolook_paper.relocalization import PolicyComparison, SimulatedRobot


POLICIES = {
    "random": "drawn at random",
    "even": "farthest from all earlier views",
    "expected": "highest expected score over the pose hypotheses",
    "blended": "expected score, blended by confidence with the mean score at that pitch times the angle",
    "gain": "highest expected gain (the product's rule)",
    "known": "highest score at the true pose (upper bound)",
}
"""Rules for the next view."""


@dataclass(frozen=True, kw_only=True)
class Relocalize(SceneOptions):
    """Simulate a camera at an unknown pose that turns in place until it is localized. Compares policies. Resumes.

    A camera starts at sampled locations with a random direction. Each further view is selected by a policy, rendered,
    and localized jointly with all views before.

    Policies: random; even (farthest from earlier views); expected (highest expected score over the pose hypotheses);
    blended (by confidence with the mean score at that pitch); gain (expected gain, as `localize --next` selects);
    known (highest score at the true pose: an upper bound).

    Examples:
      wheretolook relocalize --config configs/demo.yaml --places 5
      wheretolook relocalize --config configs/demo.yaml --policies '[even, gain]' --film lost.webp

    Args:
        places: locations in each scene, drawn from the sampled ones.
        views: maximum number of views.
        confidence: probability of the pose at which the camera stops.
        policies: rules for the next view.
        in_scenes: scenes; by default the dataset's test scenes.
        method: method of scoring.
        weights: weights of the method; by default the dataset's, or the bundled ones.
        seed: of locations, first views and random views.
        film: also write a film (.webp or .gif) of the place where the last policy gains most.
        tracking: where MLflow keeps its runs.
    """

    places: int = 30
    views: int = 4
    confidence: float = no_option(0.95)
    policies: tuple[str, ...] = tuple(POLICIES)
    in_scenes: tuple[str, ...] = ()
    method: str = "set"
    weights: Path | None = None
    seed: int = 0
    film: Path | None = None
    tracking: TrackingConfig = field(default_factory=TrackingConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        for policy in self.policies:
            check_choice("policy", policy, POLICIES)
        check_range("places", self.places, 1)
        check_range("views", self.views, 2)
        check_range("confidence", self.confidence, 0, 1)

    def run(self, log: Log = print, progress: Progress = ignore_progress) -> pd.DataFrame:
        """Simulate, write and log `<dataset>/results/relocalize.*`; needs `sample`. Returns the table by policy.

        Raises:
            ConfigError: no such scene, or no weights. WeightsError: the weights cannot be used.
            SceneError: a scene has no mesh. TrackingError: the tracking store cannot be used.
        """
        with reading(self.root, "relocalize", "relocalize"):
            dataset = load_dataset(self, "sample")
            check_store(self.tracking)
            comparison = self._comparison(dataset, log)
            table = comparison.simulate(scenes_with_meshes(dataset, self.in_scenes))
            summary = comparison.report(table, self.tracking)
            if self.film is not None:
                comparison.film(table, self.film)
        progress(1)
        return summary

    def _comparison(self, dataset: Dataset, log: Log) -> PolicyComparison:
        from wheretolook.planning.scene_map import scene_scorer
        from wheretolook.scorers.weights import resolve_weights
        from wheretolook_paper.relocalization import PolicyComparison, SimulatedRobot

        weights = resolve_weights(self.method, self.weights, dataset=dataset, log=log)

        def robot_in(files: SceneFolder) -> SimulatedRobot:
            scene = open_scene(self, files)
            return SimulatedRobot(scene, scene_scorer(scene, self.method, weights), extractor_of(files, self.extractor))

        return PolicyComparison(
            dataset,
            robot_in,
            log,
            weights,
            places=self.places,
            views=self.views,
            confidence=self.confidence,
            policies=self.policies,
            method=self.method,
            seed=self.seed,
        )
