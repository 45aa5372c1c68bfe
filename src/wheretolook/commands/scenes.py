"""`wheretolook scenes`: textured meshes, generated or loaded."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import entry_points
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any

from wheretolook.commands.options import (
    DatasetOptions,
    Log,
    MeshSource,
    Progress,
    ScenesConfig,
    ignore_progress,
    mesh_fingerprint,
    refuse_release,
)
from wheretolook.dataset.config import LOCK, Split
from wheretolook.dataset.dataset_lock import changes_dataset
from wheretolook.dataset.layout import Dataset, MappedFloor, SceneFolder
from wheretolook.scenes.config import ApartmentConfig, SceneKind
from wheretolook.utils.errors import ConfigError, SceneError, TableError
from wheretolook.utils.files import ArtifactCache, cache_key, storage_errors
from wheretolook.utils.processes import hold

if TYPE_CHECKING:
    from pathlib import Path

    from wheretolook.geometry.mesh import TexturedMesh

    MakeMesh = Callable[..., tuple[TexturedMesh, MappedFloor]]


@dataclass(frozen=True, kw_only=True)
class Scenes(DatasetOptions):
    """Make or load the textured meshes.

    Examples:
      wheretolook scenes --config configs/demo.yaml --scenes.train 5
      wheretolook scenes --config configs/own-meshes.yaml --scenes.meshes '[{path: scan.glb}]'

    Args:
        scenes: which scenes.
    """

    scenes: ScenesConfig = field(default_factory=ScenesConfig)

    @changes_dataset("scenes")
    def run(self, log: Log = print, progress: Progress = ignore_progress) -> Dataset:
        """Write `<scene>/mesh.glb` for every scene, and the dataset's description. Finished meshes are reused.

        Raises SceneError if a mesh cannot be used or two scenes have the same name, ConfigError if the dataset's folder
        holds a release, StorageError, before any work, if it cannot be written.
        """
        refuse_release(self.root)
        sources: dict[SceneFolder, tuple[MakeMesh, str]] = {}
        for scene, make, cache_inputs in [*self._generated(), *self._loaded()]:
            if scene.name in {other.name for other in sources}:
                raise SceneError("two scenes have the same name", path=self.root, value=scene.name, fix="Give a name.")
            sources[scene] = make, cache_key("scenes", cache_inputs)
        with storage_errors(self.root):  # before minutes of work
            self.root.mkdir(parents=True, exist_ok=True)
            TemporaryFile(dir=self.root).close()
        for scene, (make, key) in sources.items():
            if scene.stage_cache("scenes", key).is_current(scene.mesh):
                log(f"{scene.name}: reusing {scene.mesh}")
            else:
                with hold(scene.folder / LOCK, "scenes"):
                    save_scene(scene, make, key, log)
            progress(1)
        dataset = self._dataset(tuple(sources))
        dataset.save()
        return dataset

    def change(self, files: SceneFolder, strength: float) -> Path:
        """Return the mesh of a generated scene changed by a strength, `<scene>/changed.glb`; made unless it is there.

        Raises SceneError if the scene is not generated with these options.
        """
        from wheretolook.scenes.loading import save_glb

        for scene, make, inputs in self._generated():
            if scene.name == files.name and files.stage_cache("scenes", cache_key("scenes", inputs)).is_current():
                path = files.folder / "changed.glb"
                cache = ArtifactCache(files.folder, cache_key(inputs, strength), manifest="changed.json")
                if not cache.is_current(path):
                    mesh, _ = make(changes=strength)
                    cache.clear()  # so that no key describes a mesh of other changes
                    save_glb(mesh, path)
                    cache.store()
                return path
        fix = "Set label.changes 0, or give label the scenes options that generated the scene."
        raise SceneError("label.changes needs a scene generated with these options", path=files.folder, fix=fix)

    def _generated(self) -> Iterator[tuple[SceneFolder, MakeMesh, list[Any]]]:
        config = self.scenes
        splits: list[Split] = [*["train"] * config.train, *["val"] * config.val, *["test"] * config.test]  # type: ignore[list-item]
        for seed, split in enumerate(splits, config.seed):
            kind = config.kind_of(seed)
            scene = SceneFolder(self.root / f"{kind}-{seed:03d}", split, self.camera.camera)
            make = partial(generate_scene, kind, config.apartment, seed, self.warp_device)
            yield scene, make, [config.apartment.key(), seed, *([] if kind == "apartment" else [kind])]

    def _loaded(self) -> Iterator[tuple[SceneFolder, MakeMesh, list[Any]]]:
        for mesh in self.scenes.meshes:
            scene = SceneFolder(self.root / mesh.scene_name, mesh.split, self.camera.camera)
            yield scene, partial(_load, mesh), [mesh_fingerprint(mesh.path), mesh.up]

    def _dataset(self, scenes: tuple[SceneFolder, ...]) -> Dataset:
        """Return the dataset of the scenes; clear the sample cache of those whose camera changed.

        A description that cannot be read, such as one of another version, is replaced.
        """
        try:
            cameras = {scene.name: scene.camera for scene in Dataset.load(self.root).scenes}
        except TableError:
            cameras = {}
        for scene in scenes:
            if cameras.get(scene.name) != scene.camera:
                scene.stage_cache("sample").clear()
        return Dataset(self.root, scenes)


def save_scene(scene: SceneFolder, make: MakeMesh, key: str, log: Log) -> None:
    """Make a scene's mesh and write it; results of an earlier mesh are cleared first."""
    from wheretolook.scenes.loading import save_glb

    mesh, mapped = make()
    scene.folder.mkdir(parents=True, exist_ok=True)
    scene.stage_cache("scenes").clear()
    save_glb(mesh, scene.mesh)
    scene.save_mapped_floor(mapped)
    scene.stage_cache("scenes", key).store()
    log(f"{scene.name}: {len(mesh.triangles):,} triangles -> {scene.mesh}")


def generate_scene(
    kind: SceneKind, config: ApartmentConfig, seed: int, device: str, **changes: float
) -> tuple[TexturedMesh, MappedFloor]:
    """Return a generated scene by the installed generator, `generate(kind, config, seed, device=..., changes=...)`.

    `changes`, 0 to 1, is given only for the mesh of a changed scene.

    Raises ConfigError if no package registers one in the entry-point group `wheretolook.scene_generators`.
    """
    for entry in entry_points(group="wheretolook.scene_generators"):
        made: tuple[TexturedMesh, MappedFloor] = entry.load()(kind, config, seed, device=device, **changes)
        return made
    raise ConfigError("no generator of scenes is installed", fix="Install wheretolook again, or name scenes.meshes.")


def _load(source: MeshSource) -> tuple[TexturedMesh, MappedFloor]:
    from wheretolook.scenes.loading import load_mesh

    return load_mesh(source.path, up=source.up), ()
