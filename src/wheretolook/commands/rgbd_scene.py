"""One scene fused from an RGB-D recording, for `wheretolook scenes`."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from wheretolook.commands.options import NOT_SCENES, DatasetOptions, Log, Progress
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.geometry.camera import CameraConfig, camera_of_record, describe_camera
from wheretolook.scans.config import RgbdConfig
from wheretolook.utils.artifact_cache import cache_key
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.utils.files import check_folder_name, size_and_time, write_json

REPORT = "rgbd.json"
"""In the scene's folder: what was made of the recording."""


def fuse_recording(options: DatasetOptions, settings: RgbdConfig, log: Log, progress: Progress) -> Dataset:
    """Make a scene of an RGB-D recording: `<scene>/mesh.glb`, and its frames as a COLMAP model.

    The scene joins those of the dataset that have meshes. Its camera is the recording's colour camera, unless the
    options name another. Raises what `make_scan` does, and ConfigError if the dataset holds scenes without meshes.
    """
    root = options.root
    check_folder_name("a scene's name, scenes.rgbd.name,", settings.scene_name, NOT_SCENES)
    scene = SceneFolder(root / settings.scene_name, settings.split, options.camera.camera)
    known = {other.name: other for other in Dataset.load(root).scenes} if (root / "dataset.json").is_file() else {}
    before = known.pop(scene.name, scene)
    if without := [other.name for other in known.values() if other.stage_cache("scenes").stored_key is None]:
        fix = "Give the recording a dataset of its own: --name."
        raise ConfigError("this dataset holds scenes without meshes", path=root, value=without, fix=fix)
    cache = scene.stage_cache("scenes", cache_key("scenes", ["rgbd", *_made_from(settings)]))
    stored = cache.load(REPORT)
    if stored is not None and cache.is_current(scene.mesh, scene.frames):
        report = stored[REPORT]
        log(f"{scene.name}: reusing {scene.mesh}")
    else:
        report = _fuse(scene, settings, options.warp_device, log)
        cache.store()
    if options.camera == CameraConfig():
        scene = replace(scene, camera=camera_of_record(report["camera"]), own_camera=True)
    log(f"{scene.name}: camera {describe_camera(scene.camera)}")
    if before is not scene and before.camera != scene.camera:
        scene.stage_cache("sample").clear()
    dataset = Dataset(root, tuple(sorted([*known.values(), scene], key=lambda one: one.name)))
    dataset.save()
    progress(1)
    return dataset


def _fuse(scene: SceneFolder, settings: RgbdConfig, device: str, log: Log) -> dict[str, Any]:
    """Write mesh, frames and report of a recording; return the report."""
    from wheretolook.scans.fusion import make_scan
    from wheretolook.scenes.loading import save_glb

    scan = make_scan(settings, device)
    scene.folder.mkdir(parents=True, exist_ok=True)
    scene.stage_cache("scenes").clear()
    save_glb(scan.mesh, scene.mesh)
    scene.save_mapped_floor(())
    scan.save_model(scene.frames)
    texts = {name: str(value) if isinstance(value, Path) else value for name, value in asdict(settings).items()}
    report = {**scan.report(), "config": texts}
    write_json(scene.folder / REPORT, report)
    for line in scan.describe():
        log(f"{scene.name}: {line}")
    log(f"{scene.name}: {len(scan.mesh.triangles):,} triangles -> {scene.mesh}")
    return report


def _made_from(settings: RgbdConfig) -> list[object]:
    """Return what decides the mesh: the settings, and the names, sizes and dates of all files."""
    assert settings.folder is not None
    if not settings.folder.is_dir():
        raise SceneError("there is no such folder", path=settings.folder, fix="Name the folder of an RGB-D recording.")
    chosen = {name: value for name, value in asdict(settings).items() if name not in ("name", "split")}
    folders = filter(None, (settings.folder, settings.model))
    files = [path for folder in folders for path in sorted(folder.rglob("*")) if path.is_file()]
    return [chosen, size_and_time(files)]
