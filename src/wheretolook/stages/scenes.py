"""The scenes stage: a textured mesh for every scene, generated, loaded, or fused from a recording."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

from wheretolook.config import Experiment, MeshSource
from wheretolook.dataset.dataset_lock import changes_dataset
from wheretolook.dataset.layout import Dataset, MappedFloor, SceneFolder
from wheretolook.dataset.sampling_config import Split
from wheretolook.scenes.config import SceneKind
from wheretolook.stages.preconditions import Say, Tick, mesh_fingerprint, refuse_release
from wheretolook.utils.artifact_cache import cache_key
from wheretolook.utils.confine import safe_child
from wheretolook.utils.errors import ConfigError, SceneError

if TYPE_CHECKING:
    from wheretolook.geometry.mesh import TexturedMesh


@changes_dataset("scenes")
def make_scenes(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Dataset:
    """Stage 1: a textured mesh for every scene, `<scene>/mesh.glb`, and the dataset's description.

    With `scenes.rgbd.folder`, of one scene, fused from the RGB-D recording there, which joins the dataset's others.
    Raises SceneError if a mesh in `scenes.meshes` or the recording cannot be used or two scenes have the same name,
    ConfigError if the dataset's folder holds a release.
    """
    config = experiment.scenes
    root = experiment.root
    camera = experiment.camera.camera
    refuse_release(root)
    if config.rgbd.folder is not None:
        from wheretolook.stages.scans import scan_scene

        return scan_scene(experiment, say, tick)
    numbers: dict[Split, int] = {"train": config.train, "val": config.val, "test": config.test}
    splits = [split for split, number in numbers.items() for _ in range(number)]
    sources: dict[SceneFolder, Callable[[], tuple[TexturedMesh, MappedFloor]]] = {}
    keys: dict[SceneFolder, list[Any]] = {}
    for seed, split in enumerate(splits, config.seed):
        kind = config.kind_of(seed)
        scene = SceneFolder(safe_child(root, f"{kind}-{seed:03d}", "a scene's name"), split, camera)
        sources[scene] = partial(_generate, experiment, kind, seed)
        keys[scene] = [config.apartment.key(), seed, *([] if kind == "apartment" else [kind])]
    for source in config.meshes:
        scene = SceneFolder(safe_child(root, source.scene_name, "a scene's name"), source.split, camera)
        if scene.name in {other.name for other in sources}:
            raise SceneError("two scenes have the same name", path=source.path, value=scene.name, fix="Give it a name.")
        sources[scene] = partial(_load, source)
        keys[scene] = [mesh_fingerprint(source.path), source.up]

    for scene, make in sources.items():
        key = cache_key("scenes", keys[scene])
        if scene.stage_cache("scenes", key).is_current(scene.mesh):
            say(f"{scene.name}: reusing {scene.mesh}")
        else:
            from wheretolook.scenes.loading import save_glb

            mesh, mapped = make()
            scene.folder.mkdir(parents=True, exist_ok=True)
            scene.stage_cache("scenes").clear()  # a killed run leaves no key of results it replaced
            shutil.rmtree(scene.frames, ignore_errors=True)  # of a recording that was here before
            save_glb(mesh, scene.mesh)
            scene.save_mapped_floor(mapped)
            scene.stage_cache("scenes", key).store()
            say(f"{scene.name}: {len(mesh.triangles):,} triangles -> {scene.mesh}")
        tick(1)
    dataset = Dataset(root, tuple(sources))
    if (root / "dataset.json").is_file():
        before = Dataset.load(root).scenes
        made = {scene.name for scene in sources}
        scans = [scene for scene in before if scene.is_scanned and scene.name not in made]  # which no setting names
        dataset = Dataset(root, (*sources, *scans))
        cameras = {scene.name: scene.camera for scene in before}
        for scene in dataset.scenes:  # what was seen by another camera is no longer valid; maps know theirs
            if cameras.get(scene.name, camera) != camera:
                scene.stage_cache("sample").clear()
    dataset.save()
    return dataset


def scene_generator() -> Callable[..., tuple[TexturedMesh, MappedFloor]]:
    """Return the installed generator of scenes, `generate(kind, config, seed, device=...)`.

    Raises ConfigError if no package registers one in the entry-point group `wheretolook.scene_generators`.
    """
    for entry in entry_points(group="wheretolook.scene_generators"):
        generator: Callable[..., tuple[TexturedMesh, MappedFloor]] = entry.load()
        return generator
    raise ConfigError("no generator of scenes is installed", fix="Install wheretolook again, or name scenes.meshes.")


def _generate(experiment: Experiment, kind: SceneKind, seed: int) -> tuple[TexturedMesh, MappedFloor]:
    generate = scene_generator()
    return generate(kind, experiment.scenes.apartment, seed, device=experiment.warp_device)


def _load(source: MeshSource) -> tuple[TexturedMesh, MappedFloor]:
    from wheretolook.scenes.loading import load_mesh

    return load_mesh(source.path, up=source.up), ()
