"""`wheretolook plan`: a planned path through a scene, its views as a table, a picture, a film and a recording."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from wheretolook.commands.map import SceneOrMapOptions, imports_map
from wheretolook.commands.options import Log, Progress, ignore_progress, load_dataset, open_scene
from wheretolook.dataset.dataset_lock import reads_dataset
from wheretolook.planning.config import PlanConfig
from wheretolook.planning.view_sequence import lengths_along
from wheretolook.tracking import TrackingConfig, check_store, joined, kept_if_not_logged, log as log_to_run, start_run
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import write_text
from wheretolook.utils.package import reports, require
from wheretolook.utils.processes import hold
from wheretolook.utils.texts import score_text

if TYPE_CHECKING:
    from wheretolook.geometry.views import Views
    from wheretolook.planning.routes import PlannedPath


@dataclass(frozen=True, kw_only=True)
class Plan(SceneOrMapOptions):
    """Plan a path on which the camera can localize; a table, a picture and a film of it.

    Reads a scene's map and its mesh, if it has one, as `scenes` and `map` leave them; or a COLMAP model (--map). To plan without the mesh, in the
    space that depth images saw as free: --occlusion.model tsdf

    Examples:
      wheretolook plan --config configs/demo.yaml --scene apartment-000 --start -4,-3,1.4 --goal 4,3,1.4 \\
        --against forward --film mp4 --out way
      wheretolook plan --map sparse/0 --start 1,1,1.4 --goal 5,4,1.4 --out way

    Args:
        plan: start, goal, scores and costs, and what is written.
        tracking: where MLflow keeps its runs.
    """

    SHORT: ClassVar = {"stops": "stops.looks"}
    GROUPS: ClassVar = {"plan": ""}
    WRITES: ClassVar = "path.csv"

    plan: PlanConfig = field(default_factory=PlanConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)

    @imports_map
    @reads_dataset("plan")
    def run(self, log: Log = print, progress: Progress = ignore_progress) -> PlannedPath:
        """Plan a path, write it to `<scene>/path/path.{csv,png,gif}` and log it. Needs `map` only.

        The score of a view is the one that the method's scorer gives its exact pose (`plan_by_methods`).

        Raises:
            ConfigError: no such scene or method, no start or goal, no weights, or Rerun is asked for and not installed.
            PlanningError: the start or the goal is not free, or no path exists. WeightsError: weights cannot be used.
            SceneError, MapError: the scene has no free location, or no map with a scale.
            TrackingError: the tracking store cannot be used.
        """
        from wheretolook.planning.scene_map import path_table, path_views, plan_by_methods

        dataset = load_dataset(self, "map")
        config = self.plan
        name = config.scene or self.imported_name
        files = dataset.scenes[0] if not name and len(dataset.scenes) == 1 else dataset.scene(name)
        if config.start is None or config.goal is None:
            fix = "Give both, such as --start 1,1,1.4 --goal 5,4,1.4."
            raise ConfigError("a path needs a start and a goal", value=(config.start, config.goal), fix=fix)
        if config.rerun:
            require("rerun")
        check_store(self.tracking)
        scene = open_scene(self, files)
        methods = (*(name for name in config.against if name != config.method), config.method)
        paths = plan_by_methods(scene, dataset, methods, config.start, config.goal, config)
        method, path = list(paths.items())[-1]
        views = {name: path_views(path, scene.localization_map) for name, path in paths.items() if name != method}
        renderer = None if scene.is_photographed else scene.renderer
        views[method] = path_views(path, scene.localization_map, renderer)
        folder = (config.out or files.folder / "path").resolve()  # "." gets a name, too
        # another plan may be writing its path into the same folder
        with hold(folder.with_name(f".{folder.name}.lock"), "plan", wait_s=120.0):
            written = []
            to_map = scene.frame.world_from_map.inverse
            drawn = {name: along.in_frame(scene.frame) for name, along in views.items()}
            for report in reports("plan"):
                written += report(
                    drawn, to_map.apply(scene.landmarks.points), f"{scene.name}, {method}", folder, config.film
                )
            table = path_table(path, to_map, stopping=config.stops.looks > 1)
            write_text(folder / "path.csv", table.to_csv(index=False, lineterminator="\n"))
            if config.rerun:
                _record(views[method], scene.landmarks.points, folder / "path.rrd")
                written.append("path.rrd")
            written.insert(0, "path.csv")
            with kept_if_not_logged(f"the path in {folder}"):
                _log(self, dataset.name, scene.name, list(paths), path, [folder / name for name in written])
        log(f"{scene.name}: {_summary(path)} -> {folder}: {', '.join(written)}")
        progress(1)
        return path


def _summary(path: PlannedPath) -> str:
    """Describe a path and its stops in a line."""
    text = f"{path.length_m:.2f} m, {path.turn_deg:.0f} degrees of turning, views: {len(path.positions)}"
    if not np.isnan(path.scores).any():
        text += f", mean score {score_text(float(np.mean(path.scores)))}"
    if path.stops:
        along = lengths_along(path.positions)[[stop.place for stop in path.stops]]
        n_further = sum(len(stop.axes) for stop in path.stops)
        text += f", {n_further} further looks at stops at {', '.join(f'{at:.2f}' for at in along)} m"
        text += f": mean score {score_text(float(path.scores_with_stops.mean()))}"
    return text


def _log(options: Plan, dataset: str, scene: str, methods: list[str], path: PlannedPath, files: list[Path]) -> None:
    config = options.plan
    params: dict[str, object] = {"dataset": dataset, "scene": scene, "method": methods[-1]}
    params |= {"methods": " ".join(methods), "start": config.start, "goal": config.goal}
    params["score_weight"] = config.planner.score_weight
    metrics = {"length_m": path.length_m, "turn_deg": path.turn_deg, "score": float(path.scores.mean())}
    if config.stops.looks > 1:
        params |= {"stops.looks": config.stops.looks, "stops.least_score": config.stops.least_score}
        metrics |= {"stops": len(path.stops), "score_with_stops": float(path.scores_with_stops.mean())}
    run_name = joined(scene, methods[-1])
    with start_run(options.tracking, run_name, "plan", params, tags={"dataset": dataset}) as (client, run):
        log_to_run(client, run, metrics=metrics, files=files)


def _record(views: Views, landmarks: np.ndarray, file: Path) -> None:
    """Write a Rerun recording: landmarks, path, and the camera moving along it with image, landmarks and score."""
    from wheretolook.view.recording import open_recording

    assert views.camera is not None
    with open_recording(file) as recording:
        recording.log_landmarks(landmarks, 0.008)
        recording.log_line("world/path", views.positions)
        for number, pose in enumerate(views.cam_from_world):
            image = None if views.images is None else views.images[number]
            recording.stream.set_time("view", sequence=number)
            recording.log_camera("world/camera", pose, views.camera, image)
            recording.stream.log("world/camera/landmarks", recording.rerun.Points2D(views.pixels[number]))
            recording.stream.log("score", recording.rerun.Scalars(views.score[number]))
