"""One planned path of a scene: its views as a table, a picture, a film and a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from wheretolook.config import Experiment
from wheretolook.dataset.folders import Dataset, SceneFolder
from wheretolook.dataset.scene import is_photographed, occlusion_without_mesh, space_and_occlusion
from wheretolook.figures.path_film import film_frames, methods_figure, save_film, still_figure
from wheretolook.figures.style import save_figure
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.planning.method_paths import path_views, plan_by_methods
from wheretolook.planning.path_view import PathView
from wheretolook.planning.route_views import PlannedPath
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh
from wheretolook.stages.inputs import Say, Tick, dataset_after
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.tracking import log, start_run
from wheretolook.viewpoints.table import pose_columns

if TYPE_CHECKING:
    from wheretolook.planning.route_views import PlannedPath


def plan_scene(dataset: Dataset, experiment: Experiment, say: Say = print) -> PlannedPath:
    """Plan a path and write `path.csv`, `path.png`, the film and the recording; see `wheretolook.stages.plan.plan`.

    Raises:
        ConfigError: no such scene or method, no start or goal, no weights, or Rerun is not installed.
        PlanningError: no path can be found. SceneError, MapError: the scene cannot be used.
    """
    config = experiment.plan
    scene = dataset.scenes[0] if not config.scene and len(dataset.scenes) == 1 else dataset.scene(config.scene)
    if config.start is None or config.goal is None:
        fix = "Give plan.start and plan.goal, such as --plan.start '[1, 1, 1.4]'."
        raise ConfigError("a path needs a start and a goal", value=(config.start, config.goal), fix=fix)
    recorder = _rerun() if config.rerun else None
    photographed = is_photographed(scene)
    hides = occlusion_without_mesh(experiment.occlusion) if photographed else experiment.occlusion
    space, occlusion = space_and_occlusion(scene, dataset.camera, experiment, hides)
    methods, device = (
        (*(name for name in config.against if name != config.method), config.method),
        experiment.warp_device,
    )
    paths = plan_by_methods(
        methods, config.start, config.goal, scene, dataset, space, occlusion, config.weights, config, device
    )
    name, path = list(paths.items())[-1]
    folder = config.out or scene.folder / "path"
    one = LocalizationMap(Landmarks.load(scene.landmarks), dataset.camera, occlusion, device)
    renderer = None if photographed else WarpRenderer(load_mesh(scene.mesh), device)
    seen, landmarks = path_views(path, one, renderer), one.landmarks.points
    folder.mkdir(parents=True, exist_ok=True)
    _table(path).to_csv(folder / "path.csv", index=False, lineterminator="\n")
    save_figure(still_figure(seen, landmarks, f"{scene.name}, {name}"), folder / "path.png")
    written = ["path.csv", "path.png"]
    if len(paths) > 1:
        side_by_side = {other: path_views(its_path, one) for other, its_path in paths.items()}
        save_figure(methods_figure(side_by_side, landmarks), folder / "methods.png")
        written.append("methods.png")
    if config.film != "none":
        save_film(film_frames(seen, landmarks), folder / f"path.{config.film}")
        written.append(f"path.{config.film}")
    if recorder is not None:
        _record(recorder, seen, landmarks, dataset.camera, folder / "path.rrd")
        written.append("path.rrd")
    _log(dataset, scene, name, list(paths), path, [folder / file for file in written], experiment)
    score = "" if np.isnan(path.scores).any() else f", mean score {np.mean(path.scores):.2f}"
    say(f"{scene.name}: {path.length_m:.2f} m, {path.turn_deg:.0f} degrees of turning, {len(seen)} views{score} -> "
        f"{folder}: {', '.join(written)}")  # fmt: skip
    return path


def _log(
    dataset: Dataset, scene: SceneFolder, method: str, methods: list[str], path: PlannedPath, files: list[Path],
    experiment: Experiment,
) -> None:  # fmt: skip
    config = experiment.plan
    params = {"dataset": dataset.name, "scene": scene.name, "method": method, "methods": " ".join(methods),
              "start": config.start, "goal": config.goal, "score_weight": config.planner.score_weight}  # fmt: skip
    metrics = {"length_m": path.length_m, "turn_deg": path.turn_deg, "score": float(path.scores.mean())}
    tags = {"dataset": dataset.name}
    with start_run(experiment.tracking, f"plan {scene.name}", "plan", params, tags=tags) as (client, run):
        log(client, run, metrics=metrics)
        for file in files:
            client.log_artifact(run, str(file))


def _table(path: PlannedPath) -> pd.DataFrame:
    """A row a view: position, axis, score, and the pose cam_from_world."""
    positions, axes = (dict(zip(names, values.T, strict=True)) for names, values in (
        (("x_m", "y_m", "z_m"), path.positions), (("axis_x", "axis_y", "axis_z"), path.axes)))  # fmt: skip
    poses = pose_columns(poses_looking_along(path.positions, path.axes))
    return pd.DataFrame({**positions, **axes, "score": path.scores, **poses})


def _rerun():  # type: ignore[no-untyped-def]  # the package is no dependency
    try:
        import rerun
    except ImportError as error:
        raise ConfigError("Rerun is not installed", fix="pip install rerun-sdk, or leave plan.rerun out.") from error
    return rerun


def _record(rerun, seen: list[PathView], landmarks: np.ndarray, camera: PinholeCamera, file: Path) -> None:  # type: ignore[no-untyped-def]
    """A recording for the Rerun viewer: landmarks, path, the camera moving along it, its image, its score."""
    stream = rerun.RecordingStream("wheretolook")
    stream.save(str(file))
    stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    stream.log("world/landmarks", rerun.Points3D(landmarks, radii=0.008), static=True)
    stream.log("world/path", rerun.LineStrips3D([np.array([view.position for view in seen])]), static=True)
    for number, view in enumerate(seen):
        stream.set_time("view", sequence=number)
        pose = poses_looking_along(view.position, view.axis)
        stream.log("world/camera", rerun.Transform3D(translation=view.position, mat3x3=pose[:, :3].T))
        stream.log("world/camera/image", rerun.Pinhole(
            focal_length=camera.focal_px, width=camera.width, height=camera.height, camera_xyz=rerun.ViewCoordinates.RDF
        ))  # fmt: skip
        if view.rgb is not None:
            stream.log("world/camera/image", rerun.Image(view.rgb).compress(jpeg_quality=85))
        stream.log("world/camera/image/landmarks", rerun.Points2D(view.pixels))
        stream.log("score", rerun.Scalars(view.score))
    stream.flush()


def plan(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> PlannedPath:
    """A path through a scene on which the camera localizes, `<scene>/path/path.{csv,png,gif}`; needs the map stage.

    Raises:
        ConfigError: no such scene or method, no start or goal, no weights, or Rerun is asked for and not installed.
        PlanningError: the start or the goal is not free, or no path was found. WeightsError: weights cannot be used.
        SceneError, MapError: the scene has no free place, or no map with a scale.
    """

    path = plan_scene(dataset_after(experiment, "map"), experiment, say)
    tick(1)
    return path
