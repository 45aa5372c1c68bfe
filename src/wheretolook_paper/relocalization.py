"""Simulates a camera at an unknown location that turns in place until its pose is known.

Views are rendered, and localized jointly with all views before. Policies for the next view are compared from the same
first view.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.scene import Scene
from wheretolook.dataset.viewpoint_table import LOCALIZED, is_good, poses
from wheretolook.evaluation.statistics import ClusterBootstrap, Labels
from wheretolook.features.extractor import ExtractorConfig
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.localizer import Localizer
from wheretolook.localization.rig import Look, rig_of
from wheretolook.localization.rig_localization import JointLocalization
from wheretolook.looks.next_look import NextLookSelector, angles_to_views, mean_scores_by_pitch
from wheretolook.scorers.base import Scorer
from wheretolook.tracking import BEST_TAG, NestedRun, TrackingConfig, kept_if_not_logged
from wheretolook.utils.files import ArtifactCache, atomic_write, cache_key, fingerprint, write_text
from wheretolook.utils.texts import markdown_table
from wheretolook_paper.evaluation.comparison import interval_text, log_comparison
from wheretolook_paper.evaluation.looks import SET_COLUMNS, set_label
from wheretolook_paper.figures.animation import save_moving
from wheretolook_paper.figures.dollhouse import dollhouse
from wheretolook_paper.figures.looks import FRAME_MS, LAST_MS, film_frames, story_of_steps

COLUMNS = ("location_id", "policy", "n_looks", "hypothesis", *SET_COLUMNS[2:-1])
"""Columns of `simulate`: `hypothesis` is 0 for the chosen pose, and counts its rivals; others are those of
`wheretolook_paper.evaluation.looks`."""


class Place:
    """A camera at one location of a scene, with poses (D, 3, 4) of views that it can take."""

    def __init__(self, robot: SimulatedRobot, cam_from_world: Float) -> None:
        self.robot = robot
        self.cam_from_world = cam_from_world
        self._looks: dict[int, Look] = {}
        self._localizations: dict[tuple[int, ...], JointLocalization] = {}

    def image(self, row: int) -> NDArray[np.uint8]:
        """Render a view, (H, W, 3)."""
        scene = self.robot.scene
        return np.asarray(scene.renderer.render(scene.camera, self.cam_from_world[row : row + 1]).rgb[0])

    def localize(self, rows: Sequence[int]) -> JointLocalization:
        """Localize views jointly; the rig has the axes of the first."""
        key = tuple(rows)
        if key not in self._localizations:
            for row in key:
                if row not in self._looks:
                    self._looks[row] = self.robot.look(self.image(row))
            rig = rig_of(self.cam_from_world[list(key)])
            looks = [replace(self._looks[row], cam_from_rig=pose) for row, pose in zip(key, rig, strict=True)]
            self._localizations[key] = self.robot.localizer.joint.localize(looks)
        return self._localizations[key]

    def true_scores(self) -> Float:
        """Scores (D,) of all views at the true location."""
        center = camera_centers(self.cam_from_world[:1])
        return self.robot.scorer.score_directions(center, self.cam_from_world[:, 2, :3])[0]

    def values(self, policy: str, earlier: Sequence[int], rng: np.random.Generator) -> Float:
        """Rate all views (D,) by a policy, given the rows of earlier views."""
        if policy == "random":
            return rng.random(len(self.cam_from_world))
        if policy == "known":
            return self.true_scores()
        localization = self.localize(earlier)
        axes = self.cam_from_world[:, 2, :3] @ self.cam_from_world[earlier[0]][:, :3].T
        if policy == "even":
            return angles_to_views(localization, axes)
        selector = self.robot.selector
        heights = self.cam_from_world[:, 2, 2]
        if policy == "gain":
            return selector.gains(localization, axes, heights)
        found, scores = selector.scores_under(localization, axes)
        expected = found @ scores / max(float(found.sum()), 1e-9)
        if policy == "expected":
            return expected + 1e-9 * rng.random(len(axes))
        confidence = found.max(initial=0)
        return confidence * expected + (1 - confidence) * selector.scores_if_lost(localization, axes, heights)

    def turn(self, policy: str, first: int, n_views: int, rng: np.random.Generator) -> list[int]:
        """Return the rows of views that a policy selects after the first."""
        earlier = [first]
        while len(earlier) < min(n_views, len(self.cam_from_world)):
            values = self.values(policy, earlier, rng).copy()
            values[earlier] = -np.inf
            earlier.append(int(np.argmax(values)))
        return earlier


class SimulatedRobot:
    """A camera in a scene with a mesh, which localizes by several hypotheses and scores views by any method."""

    def __init__(self, scene: Scene, scorer: Scorer, extractor: ExtractorConfig) -> None:
        self.scene = scene
        self.scorer = scorer
        self.selector = NextLookSelector(scorer, mean_scores_by_pitch(scorer))
        config = LocalizerConfig(method="hypotheses")
        self.localizer = Localizer(scene.landmarks, scene.camera, config, extractor, scene.device)

    def look(self, rgb: NDArray[np.uint8]) -> Look:
        """Match an image (H, W, 3) with the map."""
        keypoints = self.localizer.extractor.extract(rgb)
        return Look.of(keypoints.pixels, self.localizer.match([keypoints])[0], self.localizer.camera)

    def simulate(
        self, places: Mapping[int, Float], policies: Sequence[str], n_views: int, seed: int, title: str
    ) -> pd.DataFrame:
        """Turn by each policy at places, by their id, with poses (D, 3, 4); return `COLUMNS` after each view."""
        rows: list[tuple[Any, ...]] = []
        for number, cam_from_world in tqdm(places.items(), desc=title, unit="place"):
            place = Place(self, cam_from_world)
            first = int(np.random.default_rng([seed, number]).integers(len(cam_from_world)))
            for policy in policies:
                earlier = place.turn(policy, first, n_views, np.random.default_rng([seed, number, 1]))
                for n in range(1, len(earlier) + 1):
                    result = place.localize(earlier[:n])
                    for k, pose in enumerate((result, *result.rivals)):
                        label = set_label(pose, cam_from_world[first : first + 1])
                        rows.append((number, policy, n, k, *label))
        return pd.DataFrame(rows, columns=list(COLUMNS))


def summarize(table: pd.DataFrame, confidence: float, resamples: int = 2000) -> pd.DataFrame:
    """Summarize `simulate` of several scenes, with a column `scene`: a row for each policy.

    Returns the columns `right_N`, the share of places whose pose is right after N views; `views`, the mean number until
    the confidence is reached or views run out, and `right`, the share right then; `confident`, the share of places that
    reach it, and `precision`, the share of these that is right; and `precision_area`, the area under precision over
    coverage of the poses after the last view. The first have 95 % intervals by resampling places.
    """
    table = table[table["hypothesis"] == 0]
    good = table.assign(good=is_good(table))
    rows = []
    for policy in good["policy"].unique():
        part = good[good["policy"] == policy]
        places = part.set_index(["scene", "location_id", "n_looks"])[["good", "confidence"]].unstack()
        right = places["good"].to_numpy(float)
        reached = places["confidence"].to_numpy() >= confidence
        stop = np.argmax(np.column_stack([reached[:, :-1], np.ones(len(reached), dtype=bool)]), axis=1)
        at_stop = right[np.arange(len(right)), stop]
        stopped = reached.any(axis=1)
        scenes = np.unique(places.index.get_level_values("scene"), return_inverse=True)[1]
        bootstrap = ClusterBootstrap(np.arange(len(right)), resamples, 0, scenes)
        values = np.column_stack([right, stop + 1, at_stop])
        low, high = bootstrap.ratio_interval(values, np.ones((len(right), 1)))
        names = [*(f"right_{n}" for n in range(1, right.shape[1] + 1)), "views", "right"]
        row: dict[str, Any] = {"policy": policy, "places": len(right)}
        for name, value, least, most in zip(names, values.mean(0), low, high, strict=True):
            row |= {name: value, f"{name}_low": least, f"{name}_high": most}
        precision = at_stop[stopped].mean() if stopped.any() else np.nan
        row |= {"confident": stopped.mean(), "precision": precision}
        final = part[part["n_looks"] == part["n_looks"].max()]
        of_poses = final["confidence"].where(final["status"] == LOCALIZED).to_numpy(float)
        rows.append(row | {"precision_area": precision_area(of_poses, final["good"].to_numpy())})
    return pd.DataFrame(rows)


def summary_markdown(summary: pd.DataFrame, confidence: float) -> str:
    """Format `summarize` as Markdown."""
    numbers = [int(name[6:]) for name in map(str, summary) if name.startswith("right_") and name[6:].isdigit()]
    shares = [*(f"right_{n}" for n in numbers), "right"]
    heads = ["policy", "places", *(f"{n} views" if n > 1 else "first view" for n in numbers)]
    heads += ["right at stop", "views until stop", "confident", "of these right", "area under precision over coverage"]
    lines = []
    for row in summary.to_dict("records"):
        cells = [interval_text(row, name) for name in shares]
        views = interval_text(row, "views", 1, 2)
        last = [f"{100 * row[name]:.1f}" for name in ("confident", "precision")]
        lines.append([str(row["policy"]), str(row["places"]), *cells, views, *last, f"{row['precision_area']:.3f}"])
    head = f"Share of places whose pose is right, in % [95 % interval over places]; stop at a confidence of {confidence:g}."
    return f"{head}\n\n{markdown_table(heads, lines)}\n"


@dataclass(frozen=True)
class PolicyComparison:
    """A comparison of policies in scenes of a dataset, in `<dataset>/results/relocalize/`.

    Attributes:
        robot_in: opens a scene with the scorer of `method` and `weights`.
        log: prints a line of progress.
        places: locations in each scene, drawn from the sampled ones.
        views: maximum number of views.
        confidence: probability of the pose at which the camera stops.
        policies: rules for the next view.
        seed: of locations, first views and random views.
    """

    dataset: Dataset
    robot_in: Callable[[SceneFolder], SimulatedRobot]
    log: Callable[[str], None]
    weights: Path | None
    places: int
    views: int
    confidence: float
    policies: Sequence[str]
    method: str
    seed: int

    @property
    def results(self) -> Path:
        """Folder of the results."""
        return self.dataset.root / "results"

    def simulate(self, scenes: Sequence[SceneFolder]) -> pd.DataFrame:
        """Simulate in scenes, or read the cached results; return `SimulatedRobot.simulate` with the column `scene`."""
        tables = [self._simulated(files).assign(scene=files.name) for files in scenes]
        table = pd.concat(tables, ignore_index=True)
        with atomic_write(self.results / "relocalize" / "poses.parquet") as partial:
            table.to_parquet(partial, index=False)
        return table

    def report(self, table: pd.DataFrame, tracking: TrackingConfig) -> pd.DataFrame:
        """Write and log `<dataset>/results/relocalize.*`. Returns `summarize`."""
        summary = summarize(table, self.confidence)
        markdown = summary_markdown(summary, self.confidence)
        csv, page = files = [self.results / f"relocalize.{ending}" for ending in ("csv", "md")]
        write_text(csv, summary.to_csv(index=False, float_format="%.6g", lineterminator="\n"))
        write_text(page, markdown)
        with kept_if_not_logged(f"the comparison in {self.results}"):
            self._log_run(summary, files, tracking)
        self.log(markdown)
        self.log(f"-> {csv}, {page.name}; every pose in {self.results / 'relocalize'}")
        return summary

    def film(self, table: pd.DataFrame, path: Path) -> None:
        """Film the place where the last policy succeeds with the lowest probability of the first view's pose."""
        last = table[(table["policy"] == self.policies[-1]) & (table["hypothesis"] == 0)]
        right = last[is_good(last) & (last["n_looks"] == self.views)].set_index(["scene", "location_id"]).index
        first = last[last["n_looks"] == 1].set_index(["scene", "location_id"])
        lost = first[first.index.isin(right) & ~is_good(first)]
        if lost.empty:
            self.log("no film: the last policy localizes no place where the first view fails")
            return
        scene, number = lost["n_inliers"].idxmax()
        files = self.dataset.scene(str(scene))
        robot = self.robot_in(files)
        place = Place(robot, self._places(files)[int(number)])
        start = int(np.random.default_rng([self.seed, int(number)]).integers(len(place.cam_from_world)))
        rows = place.turn(self.policies[-1], start, self.views, np.random.default_rng([self.seed, int(number), 1]))
        images = np.stack([place.image(row) for row in rows])
        results = [place.localize(rows[:n]) for n in range(1, len(rows) + 1)]
        story = story_of_steps(files.camera, place.cam_from_world[rows], images, results)
        height = float(camera_centers(story.cam_from_world)[0, 2])
        house = dollhouse(robot.scene.mesh, elevation_deg=62, cut_m=height + 0.3, width_px=700)
        save_moving((frame for frame, _ in film_frames(story, house)), FRAME_MS, path, LAST_MS)
        self.log(f"film of {scene}, location {number} -> {path}")

    def _places(self, files: SceneFolder) -> dict[int, Float]:
        """Return poses (D, 3, 4) of the sampled views at random locations, by the location's id."""
        table = files.read_table()
        of_view = table["location_id"].to_numpy(np.int64)
        ids = np.random.default_rng(self.seed).permutation(np.unique(of_view))[: self.places]
        cam_from_world = poses(table)
        return {int(number): cam_from_world[of_view == number] for number in ids}

    def _simulated(self, files: SceneFolder) -> pd.DataFrame:
        """Simulate in a scene, or read the cached result."""
        paths = (files.mesh, files.landmarks, files.table, self.weights)
        inputs = [fingerprint(path) for path in paths if path is not None]
        settings: list[Any] = [self.places, self.views, self.policies, self.method, self.seed]
        key = cache_key("1", [settings, inputs])
        cache = ArtifactCache(self.results / "relocalize" / files.name, key, "poses")
        stored = cache.load("poses.parquet")
        if stored is not None:
            return stored["poses.parquet"]
        robot = self.robot_in(files)
        table = robot.simulate(self._places(files), self.policies, self.views, self.seed, files.name)
        return cache.store({"poses.parquet": table})["poses.parquet"]

    def _log_run(self, summary: pd.DataFrame, files: Sequence[Path], tracking: TrackingConfig) -> None:
        """Log the comparison as a run with its files, and a nested run for each policy."""
        params = {"dataset": self.dataset.name, "places": self.places, "views": self.views, "method": self.method}
        params |= {"confidence": self.confidence, "seed": self.seed}
        rows = summary.set_index("policy").to_dict("index")
        best = max(rows, key=lambda policy: float(rows[policy]["right"]) if policy != "known" else -1.0)
        metrics = {str(name): float(value) for name, value in rows[best].items()}
        nested = [
            NestedRun(str(policy), {**params, "policy": policy}, {str(k): float(v) for k, v in row.items()})
            for policy, row in rows.items()
        ]
        about = {BEST_TAG: str(best)}
        log_comparison(tracking, "all policies", "relocalize", params, metrics, nested, files, about=about)


def precision_over_coverage(confidence: Float, right: Labels) -> tuple[Float, Float]:
    """Compute the share of right poses among the most confident ones, by the share of the queries that these are.

    Given the confidence (B,) in each query's pose, not finite without a pose, and whether it is right (B,). Returns the
    coverage k / B and the precision (P,) of the k most confident of P poses; equal confidences count as one threshold.
    The mean of the precision over all queries, 0 where there is no pose, is `precision_area` (Arnold et al., ECCV 2022).
    """
    order = np.argsort(-confidence[np.isfinite(confidence)], kind="stable")
    sorted_confidence = confidence[np.isfinite(confidence)][order]
    n_right = np.cumsum(right[np.isfinite(confidence)][order])
    # all poses of the same confidence are accepted together
    last = np.searchsorted(-sorted_confidence, -sorted_confidence, side="right")
    count = np.arange(1, len(order) + 1)
    return count / max(len(confidence), 1), n_right[last - 1] / last


def precision_area(confidence: Float, right: Labels) -> float:
    """Compute the area under `precision_over_coverage` in [0, 1]."""
    return float(precision_over_coverage(confidence, right)[1].sum() / max(len(confidence), 1))
