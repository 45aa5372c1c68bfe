"""`wheretolook viewpoint-map`: every direction scored at every free voxel of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from wheretolook.commands.map import SceneOrMapOptions, imports_map
from wheretolook.commands.options import (
    Log,
    MaskOptions,
    Progress,
    ignore_progress,
    load_dataset,
    naming_file,
    open_scene,
)
from wheretolook.dataset.dataset_lock import reads_dataset
from wheretolook.planning.config import MappedLattice
from wheretolook.scorers.weights import resolve_weights
from wheretolook.utils.errors import ConfigError, reject

if TYPE_CHECKING:
    from wheretolook.planning.viewpoint_map import ViewpointMap


@dataclass(frozen=True, kw_only=True)
class BuildViewpointMap(MappedLattice, MaskOptions, SceneOrMapOptions):
    """Score every direction at every free voxel of a scene, for planners to query. Needs no labels.

    Reads a scene's map and its mesh, as `scenes` and `map` leave them, or a COLMAP model (--map); a scene of photographs has no mesh, and is free
    according to scenes.mapped_space. Without weights or a method, the best weights of the dataset, or else the bundled
    ones, score the views. The folder holds plain arrays and LAYOUT.txt, which describes them; in Python:

      from wheretolook import ViewpointMap
      viewpoint_map = ViewpointMap.load("apartment.map", mmap=True)
      choice = viewpoint_map.best((1.0, 2.0, 1.5))    # None where no camera can be, else axis, score, n_visible

    Examples:
      wheretolook viewpoint-map --config configs/demo.yaml --scene apartment-000 --out apartment.map
      wheretolook viewpoint-map --map sparse/0 --mesh scan.glb --out house.map
      wheretolook viewpoint-map --map sparse/0 --mesh scan.glb --scale 1 --grid 40 40 6 --nav2 masks --camera-z 1.2

    Args:
        scene: name of the scene; empty for all scenes of the dataset.
        method: method that scores the views. See `wheretolook evaluate --list-methods`; empty for the one that the
            weights are of, or bins if there are none.
        accuracy: limits of the errors in metres and degrees that the scores refer to, for the method set; by default
            those of the weights, 0.05,0.4.
        weights: file of weights that the train stage wrote, for a learned method. Unless a method is named,
            the best of the dataset, or else of those that ship, for cameras with their field of view.
        out: folder to write; empty for `<data>/<name>/<scene>/viewpoint-map`. Of one scene only.
        anywhere: allow weights adapted to another scene.
    """

    GROUPS: ClassVar = {"viewpoint_map": ""}
    WRITES: ClassVar = "viewpoint_map.json"

    scene: str = ""
    method: str = ""
    accuracy: tuple[float, float] | None = None
    weights: Path | None = None
    out: Path | None = None
    anywhere: bool = False

    def __post_init__(self) -> None:
        MappedLattice.__post_init__(self)
        SceneOrMapOptions.__post_init__(self)
        reject((self.camera_z is not None and self.nav2 is None, "--camera-z needs --nav2", self.camera_z))

    @imports_map
    @reads_dataset("viewpoint-map")
    def run(self, log: Log = print, progress: Progress = ignore_progress) -> dict[str, ViewpointMap]:
        """Write `<scene>/viewpoint-map/`, and return the viewpoint maps by the scene's name. Needs `map` only.

        Raises:
            ConfigError: no such scene or method, the method needs weights, or masks for Nav2 (`check_mask`).
            WeightsError: the weights cannot be used.
            SceneError: there is no mesh, or no voxel is free. MapFormatError: the map's folder holds something else.
        """
        from wheretolook.planning.nav2 import check_mask, places_at_height, write_mask
        from wheretolook.planning.scene_map import scene_scorer, scene_viewpoint_map

        dataset = load_dataset(self, "map")
        name = self.scene or self.imported_name
        scenes = (dataset.scene(name),) if name else dataset.scenes
        if (self.out or self.nav2) and len(scenes) != 1:
            raise ConfigError("--out and --nav2 are of one scene", value=len(scenes), fix="Give --scene.")
        weights = self.weights
        if not self.method and weights is None:
            weights = resolve_weights(dataset=dataset, log=log)
            if weights is not None:
                log(f"scored by {weights}")
        built: dict[str, ViewpointMap] = {}
        for files in scenes:
            scene = open_scene(self, files)
            with naming_file(scene.folder.source):
                scorer = scene_scorer(scene, self.method, weights, self.anywhere, self.accuracy)
                if self.nav2:
                    check_mask(self.nav2, scorer, self.camera_z)
                viewpoint_map = scene_viewpoint_map(scene, self, scorer)
            folder = self.out or files.folder / "viewpoint-map"
            viewpoint_map.save(folder)
            if self.nav2 and self.camera_z is not None:
                write_mask(self.nav2, *places_at_height(viewpoint_map, self.camera_z))
            built[scene.name] = viewpoint_map
            n_rows, n_directions = viewpoint_map.scores.shape
            scored = f"{n_directions} directions at {n_rows} free voxels of {len(viewpoint_map.grid)}"
            log(f"{scene.name}: {scored}, scored by {viewpoint_map.origin.scorer} -> {folder}")
            progress(1)
        return built
