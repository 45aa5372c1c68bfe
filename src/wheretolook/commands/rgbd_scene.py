"""One scene fused from an RGB-D recording, for `wheretolook scenes`."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from wheretolook.commands.options import DatasetOptions, Log, Progress
from wheretolook.commands.scenes_config import NOT_SCENES
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.geometry.camera import CameraConfig, camera_of_record, describe_camera
from wheretolook.scans.config import RgbdConfig
from wheretolook.utils.artifact_cache import cache_key
from wheretolook.utils.confine import check_folder_name, safe_child
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.utils.files import write_json
from wheretolook.utils.reading import read_json_object

REPORT = "rgbd.json"
"""In the scene's folder: what was made of the recording."""


def fuse_recording(options: DatasetOptions, settings: RgbdConfig, log: Log, progress: Progress) -> Dataset:
    """Make a scene of an RGB-D recording: `<scene>/mesh.glb`, and its frames as a COLMAP model.

    The scene joins those of the dataset that have meshes. Its camera is the recording's colour camera, unless the
    options name another. Raises what `make_scan` does, and ConfigError if the dataset holds scenes without meshes.
    """
    root = options.root
    check_folder_name("a scene's name, scenes.rgbd.name,", settings.scene_name, NOT_SCENES)
    scene = SceneFolder(safe_child(root, settings.scene_name, "a scene's name"), settings.split, options.camera.camera)
    known = {other.name: other for other in Dataset.load(root).scenes} if (root / "dataset.json").is_file() else {}
    others = [other for other in known.values() if other.name != scene.name]
    if without := [other.name for other in others if other.stage_cache("scenes").stored_key is None]:
        fix = "Give the recording a dataset of its own: --name."
        raise ConfigError("this dataset holds scenes without meshes", path=root, value=without, fix=fix)
    key = cache_key("scenes", ["rgbd", *_made_from(settings)])
    if scene.stage_cache("scenes", key).is_current(scene.mesh, scene.folder / REPORT, scene.frames):
        log(f"{scene.name}: reusing {scene.mesh}")
    else:
        _fuse(scene, settings, options.warp_device, key, log)
    if options.camera == CameraConfig():
        scene = replace(scene, camera=_colour_camera(scene), own_camera=True)
    log(f"{scene.name}: camera {describe_camera(scene.camera)}")
    if scene.name in known and known[scene.name].camera != scene.camera:
        scene.stage_cache("sample").clear()
    dataset = Dataset(root, tuple(sorted([*others, scene], key=lambda one: one.name)))
    dataset.save()
    progress(1)
    return dataset


def _fuse(scene: SceneFolder, settings: RgbdConfig, device: str, key: str, log: Log) -> None:
    from wheretolook.scans.fusion import make_scan
    from wheretolook.scenes.loading import save_glb

    scan = make_scan(settings, device)
    scene.folder.mkdir(parents=True, exist_ok=True)
    scene.stage_cache("scenes").clear()
    save_glb(scan.mesh, scene.mesh)
    scene.save_mapped_floor(())
    scan.save_model(scene.frames)
    texts = {name: str(value) if isinstance(value, Path) else value for name, value in asdict(settings).items()}
    write_json(scene.folder / REPORT, {**scan.report(), "config": texts})
    scene.stage_cache("scenes", key).store()
    for line in scan.describe():
        log(f"{scene.name}: {line}")
    log(f"{scene.name}: {len(scan.mesh.triangles):,} triangles -> {scene.mesh}")


def _made_from(settings: RgbdConfig) -> list[object]:
    """Return what decides the mesh: the settings, and the names, sizes and dates of all files."""
    assert settings.folder is not None
    if not settings.folder.is_dir():
        raise SceneError("there is no such folder", path=settings.folder, fix="Name the folder of an RGB-D recording.")
    chosen = {name: value for name, value in asdict(settings).items() if name not in ("name", "split")}
    folders = [settings.folder, *([settings.model] if settings.model else [])]
    stats = [(str(path), path.stat()) for folder in folders for path in sorted(folder.rglob("*")) if path.is_file()]
    return [chosen, [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats]]


def _colour_camera(scene: SceneFolder) -> Any:
    path = scene.folder / REPORT
    try:
        return camera_of_record(read_json_object(path)["camera"])
    except (OSError, ValueError, KeyError, TypeError, ConfigError) as error:
        fix = "Remove it, and run `wheretolook scenes` again."
        raise SceneError(f"the recording's report is damaged: {error}", path=path, fix=fix) from error
