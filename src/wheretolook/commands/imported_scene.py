"""Commands on a scene of a dataset, or on a COLMAP model that they import as one first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import wraps
from pathlib import Path
from typing import Any

from wheretolook.commands.map import Map
from wheretolook.commands.options import DatasetOptions, Log, Progress, SceneOptions, ignore_progress, select_options
from wheretolook.mapping.config import ExistingModelConfig, FrameOptions, MapConfig, place_name
from wheretolook.utils.validation import reject


@dataclass(frozen=True, kw_only=True)
class SceneOrMapOptions(SceneOptions, FrameOptions):
    """A scene of a dataset, or a COLMAP model.

    Args:
        name: name of the dataset; by default demo, or with --map that of the map.
        map: instead of a scene: folder of a COLMAP model, imported first as `wheretolook map --model` does.
        mesh: a mesh of the map's scene (GLB, OBJ, PLY) in its frame.
        database: the map's features: COLMAP's database.db, or hloc's feats-*.h5.
        camera_id: the camera_id of one of the map's cameras, if it has several.
    """

    name: str = ""
    map: Path | None = None
    mesh: Path | None = None
    database: Path | None = None
    camera_id: int | None = None

    def __post_init__(self) -> None:
        frame = self.frame_options()
        of_map = next(filter(None, (self.mesh, self.database, self.camera_id, *vars(frame).values())), None)
        names = "--mesh, --database, --camera-id, --scale, --distance, --positions and --up"
        reject((self.map is None and of_map is not None, f"{names} belong to --map", str(of_map)))
        if not self.name:
            object.__setattr__(self, "name", self.imported_name or DatasetOptions.name)
        super().__post_init__()

    @property
    def imported_name(self) -> str:
        """Name of the scene that `map` is imported as; empty without it."""
        return "" if self.map is None else place_name(self.map)


def imports_map(run: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate `run` of a command to import the model in its option `map` first, unless its scene is up to date."""

    @wraps(run)
    def run_on_scene(command: Any, log: Log = print, progress: Progress = ignore_progress) -> Any:
        if command.map is not None:
            files = {"database": command.database, "mesh": command.mesh}
            existing = ExistingModelConfig(command.map, **files, camera_id=command.camera_id)
            mapping = MapConfig(frame=command.frame_options(), extractor=command.mapping.extractor, existing=existing)
            replace(select_options(Map, command), mapping=mapping).run(log)
        return run(command, log, progress)

    return run_on_scene
