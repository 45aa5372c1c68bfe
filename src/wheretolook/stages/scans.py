"""The scenes stage for an RGB-D recording: one scene, fused from it."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from wheretolook.config import NOT_SCENES, Experiment
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.geometry.camera import CameraConfig, camera_of_record, describe_camera
from wheretolook.scans.config import RgbdConfig
from wheretolook.stages.preconditions import Say, Tick
from wheretolook.utils.artifact_cache import cache_key
from wheretolook.utils.confine import check_folder_name, safe_child
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.utils.files import write_json
from wheretolook.utils.reading import read_json_object

REPORT = "rgbd.json"  # in the scene's folder: what came of the recording


def scan_scene(experiment: Experiment, say: Say, tick: Tick) -> Dataset:
    """Make a scene of the recording in `scenes.rgbd.folder`: `<scene>/mesh.glb`, and its frames as a COLMAP model.

    The scene joins those of the dataset that have meshes. The recording's colour camera looks, unless the settings name
    another. Raises what `make_scan` does, and ConfigError if the dataset holds scenes without meshes.
    """
    settings = experiment.scenes.rgbd
    root = experiment.root
    check_folder_name("a scene's name, scenes.rgbd.name,", settings.scene_name, NOT_SCENES)
    scene = SceneFolder(
        safe_child(root, settings.scene_name, "a scene's name"), settings.split, experiment.camera.camera
    )
    others = _others(root, scene)
    key = cache_key("scenes", ["rgbd", *_made_from(settings)])
    if scene.stage_cache("scenes", key).is_current(scene.mesh, scene.folder / REPORT, scene.frames):
        say(f"{scene.name}: reusing {scene.mesh}")
    else:
        from wheretolook.scans.fusion import make_scan
        from wheretolook.scenes.loading import save_glb

        scan = make_scan(settings, experiment.warp_device)
        scene.folder.mkdir(parents=True, exist_ok=True)
        scene.stage_cache("scenes").clear()  # a killed run leaves no key of results it replaced
        save_glb(scan.mesh, scene.mesh)
        scene.save_mapped_floor(())
        scan.save_model(scene.frames)
        write_json(scene.folder / REPORT, {**scan.report(), "config": _as_text(settings)})
        scene.stage_cache("scenes", key).store()
        for line in scan.describe():
            say(f"{scene.name}: {line}")
        say(f"{scene.name}: {len(scan.mesh.triangles):,} triangles -> {scene.mesh}")
    if experiment.camera == CameraConfig():
        scene = replace(scene, camera=camera_of_record(_report(scene)["camera"]), own_camera=True)
    say(f"{scene.name}: looked at with {describe_camera(scene.camera)}")
    known = {other.name: other for other in Dataset.load(root).scenes} if (root / "dataset.json").is_file() else {}
    if scene.name in known and known[scene.name].camera != scene.camera:
        scene.stage_cache("sample").clear()
    dataset = Dataset(root, tuple(sorted([*others, scene], key=lambda one: one.name)))
    dataset.save()
    tick(1)
    return dataset


def _as_text(settings: RgbdConfig) -> dict[str, Any]:
    return {name: str(value) if isinstance(value, Path) else value for name, value in asdict(settings).items()}


def _others(root: Path, scene: SceneFolder) -> list[SceneFolder]:
    """The dataset's other scenes. Raises ConfigError if one has no mesh, so that stages do not work on both."""
    if not (root / "dataset.json").is_file():
        return []
    others = [other for other in Dataset.load(root).scenes if other.name != scene.name]
    without = [other.name for other in others if other.stage_cache("scenes").stored_key is None]
    if without:
        fix = "Give the recording a dataset of its own: --name."
        raise ConfigError("this dataset holds scenes that no mesh was made for", path=root, value=without, fix=fix)
    return others


def _made_from(settings: RgbdConfig) -> list[object]:
    """What decides the mesh: the settings, and the names, sizes and dates of all files."""
    assert settings.folder is not None
    if not settings.folder.is_dir():
        raise SceneError("there is no such folder", path=settings.folder, fix="Name the folder of an RGB-D recording.")
    chosen = {name: value for name, value in asdict(settings).items() if name not in ("name", "split")}
    folders = [settings.folder, *([settings.model] if settings.model else [])]
    stats = [(str(path), path.stat()) for folder in folders for path in sorted(folder.rglob("*")) if path.is_file()]
    return [chosen, [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats]]


def _report(scene: SceneFolder) -> dict[str, Any]:
    path = scene.folder / REPORT
    try:
        report = read_json_object(path)
        camera_of_record(report["camera"])
        return report
    except (OSError, ValueError, KeyError, TypeError, ConfigError) as error:
        fix = "Remove it, and run the scenes stage again."
        raise SceneError(f"the recording's report is damaged: {error}", path=path, fix=fix) from error
