"""`wheretolook relocalize`: a camera at an unknown pose turns until it is localized, in simulation; resumes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

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
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.tracking import TrackingConfig, check_store, kept_if_not_logged
from wheretolook.utils.errors import check_choice, check_range, no_option
from wheretolook.utils.files import atomic_write, fingerprint, write_text
from wheretolook_paper.commands.compare_paths import scenes_with_meshes

if TYPE_CHECKING:
    import pandas as pd

    from wheretolook.geometry.poses import Float
    from wheretolook_paper.evaluation.relocalization import SimulatedRobot

POLICIES = {
    "random": "drawn at random",
    "even": "farthest from all earlier views",
    "expected": "highest expected score over the pose hypotheses",
    "blended": "expected score, blended by confidence with the mean score at that pitch times the angle",
    "gain": "highest expected gain (the product's rule)",
    "known": "highest score at the true pose (upper bound)",
}
"""Rules for the next view."""

FOLDER = "relocalize"
"""In `results/`: a folder for each scene, and the poses of all scenes."""


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
        import pandas as pd

        from wheretolook_paper.evaluation.relocalization import summarize, summary_markdown

        with reading(self.root, "relocalize", FOLDER):
            dataset = load_dataset(self, "sample")
            check_store(self.tracking)
            scenes = scenes_with_meshes(dataset, self.in_scenes)
            tables = [self._simulated(dataset, files, log).assign(scene=files.name) for files in scenes]
            table = pd.concat(tables, ignore_index=True)
            summary = summarize(table, self.confidence)
            results = dataset.root / "results"
            markdown = summary_markdown(summary, self.confidence)
            write_text(results / f"{FOLDER}.csv", summary.to_csv(index=False, float_format="%.6g", lineterminator="\n"))
            write_text(results / f"{FOLDER}.md", markdown)
            with atomic_write(results / FOLDER / "poses.parquet") as partial:
                table.to_parquet(partial, index=False)
            with kept_if_not_logged(f"the comparison in {results}"):
                self._log(dataset, summary, results)
            log(markdown)
            log(f"-> {results / FOLDER}.csv, {FOLDER}.md; every pose in {results / FOLDER}")
            if self.film is not None:
                self._film(dataset, table, self.film, log)
        progress(1)
        return summary

    def _robot(self, dataset: Dataset, files: SceneFolder, log: Log) -> SimulatedRobot:
        from wheretolook.planning.scene_map import scene_scorer
        from wheretolook.scorers.weights import resolve_weights
        from wheretolook_paper.evaluation.relocalization import SimulatedRobot

        scene = open_scene(self, files)
        weights = resolve_weights(self.method, self.weights, dataset=dataset, log=log)
        extractor = extractor_of(files, self.extractor)
        return SimulatedRobot(scene, scene_scorer(scene, self.method, weights), extractor)

    def _places(self, files: SceneFolder) -> dict[int, Float]:
        """Return poses (D, 3, 4) of the sampled views at random locations, by the location's id."""
        from wheretolook.dataset.viewpoint_table import poses

        table = files.read_table()
        of_view = table["location_id"].to_numpy(np.int64)
        ids = np.random.default_rng(self.seed).permutation(np.unique(of_view))[: self.places]
        cam_from_world = poses(table)
        return {int(number): cam_from_world[of_view == number] for number in ids}

    def _simulated(self, dataset: Dataset, files: SceneFolder, log: Log) -> pd.DataFrame:
        """Simulate in a scene, or read the cached result."""
        from wheretolook.scorers.weights import resolve_weights
        from wheretolook.utils.files import ArtifactCache, cache_key

        weights = resolve_weights(self.method, self.weights, dataset=dataset, log=log)
        inputs = [fingerprint(path) for path in (files.mesh, files.landmarks, files.table, weights) if path is not None]
        settings: list[Any] = [self.places, self.views, self.policies, self.method, self.seed]
        cache = ArtifactCache(
            dataset.root / "results" / FOLDER / files.name, cache_key("1", [settings, inputs]), "poses"
        )
        stored = cache.load("poses.parquet")
        if stored is not None:
            return stored["poses.parquet"]
        robot = self._robot(dataset, files, log)
        table = robot.simulate(self._places(files), self.policies, self.views, self.seed, files.name)
        return cache.store({"poses.parquet": table})["poses.parquet"]

    def _log(self, dataset: Dataset, summary: pd.DataFrame, results: Path) -> None:
        """Log the comparison as a run with its files, and a nested run for each policy."""
        from wheretolook.tracking import BEST_TAG, NestedRun
        from wheretolook_paper.evaluation.comparison import log_comparison

        params = {"dataset": dataset.name, "places": self.places, "views": self.views, "method": self.method}
        params |= {"confidence": self.confidence, "seed": self.seed}
        rows = summary.set_index("policy").to_dict("index")
        best = max(rows, key=lambda policy: float(rows[policy]["right"]) if policy != "known" else -1.0)
        metrics = {str(name): float(value) for name, value in rows[best].items()}
        nested = [
            NestedRun(str(policy), {**params, "policy": policy}, {str(k): float(v) for k, v in row.items()})
            for policy, row in rows.items()
        ]
        files = [results / f"{FOLDER}.csv", results / f"{FOLDER}.md"]
        about = {BEST_TAG: str(best)}
        log_comparison(self.tracking, "all policies", FOLDER, params, metrics, nested, files, about=about)

    def _film(self, dataset: Dataset, table: pd.DataFrame, path: Path, log: Log) -> None:
        """Film the place where the last policy succeeds with the lowest probability of the first view's pose."""
        from wheretolook.dataset.viewpoint_table import is_good
        from wheretolook.geometry.poses import camera_centers
        from wheretolook_paper.evaluation.relocalization import Place
        from wheretolook_paper.figures.animation import save_moving
        from wheretolook_paper.figures.dollhouse import dollhouse
        from wheretolook_paper.figures.looks import FRAME_MS, LAST_MS, film_frames, story_of_steps

        last = table[(table["policy"] == self.policies[-1]) & (table["hypothesis"] == 0)]
        right = last[is_good(last) & (last["n_looks"] == self.views)].set_index(["scene", "location_id"]).index
        first = last[last["n_looks"] == 1].set_index(["scene", "location_id"])
        lost = first[first.index.isin(right) & ~is_good(first)]
        if lost.empty:
            log("no film: the last policy localizes no place where the first view fails")
            return
        scene, number = lost["n_inliers"].idxmax()
        files = dataset.scene(str(scene))
        robot = self._robot(dataset, files, log)
        place = Place(robot, self._places(files)[int(number)])
        start = int(np.random.default_rng([self.seed, int(number)]).integers(len(place.cam_from_world)))
        rows = place.turn(self.policies[-1], start, self.views, np.random.default_rng([self.seed, int(number), 1]))
        images = np.stack([place.image(row) for row in rows])
        results = [place.localize(rows[:n]) for n in range(1, len(rows) + 1)]
        story = story_of_steps(files.camera, place.cam_from_world[rows], images, results)
        height = float(camera_centers(story.cam_from_world)[0, 2])
        house = dollhouse(robot.scene.mesh, elevation_deg=62, cut_m=height + 0.3, width_px=700)
        save_moving((frame for frame, _ in film_frames(story, house)), FRAME_MS, path, LAST_MS)
        log(f"film of {scene}, location {number} -> {path}")
