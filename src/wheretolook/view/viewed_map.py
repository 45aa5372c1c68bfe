"""The map that the viewer shows: a scene of a dataset, or a COLMAP model with or without a mesh."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wheretolook.dataset.environment import (
    ColmapEnvironment,
    ColmapFiles,
    Environment,
    EnvironmentConfig,
    SceneEnvironment,
)
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.utils.errors import ConfigError, MapError, SceneError, TableError
from wheretolook.view import drawing
from wheretolook.view.weights import AvailableWeights, given_weights, map_weights, scene_weights

if TYPE_CHECKING:  # torch and Warp are imported when first needed: the page opens before them
    import pandas as pd

    from wheretolook.dataset.layout import SceneFolder
    from wheretolook.geometry.mesh import TexturedMesh
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.mapping.landmarks import Landmarks
    from wheretolook.select.where_to_look import WhereToLook
    from wheretolook.view.photographs import Photographs
    from wheretolook.view.scores import VisibleLandmarks

MAX_SCORERS = 8  # kept in memory; those of large maps take 100 MB each
DIRECTIONS = 500  # scored at a location, as by `wheretolook select`
OCCLUSION_BYTES = 1 << 26  # memory for cached lines of sight


@dataclass(eq=False)
class ViewedMap:
    """An environment with everything else that the viewer shows. Methods are not thread-safe."""

    name: str
    environment: Environment
    weights: AvailableWeights
    labels: pd.DataFrame | None = None  # labelled viewpoints
    photographs: Photographs | None = None
    _maps: dict[str, LocalizationMap] = field(default_factory=dict, init=False)
    _selectors: dict[tuple[str, str, int], WhereToLook] = field(default_factory=dict, init=False)

    @property
    def landmarks(self) -> Landmarks:
        """The map's landmarks."""
        return self.environment.landmarks

    @property
    def camera(self) -> Camera:
        """The camera whose views are shown."""
        return self.environment.camera

    @property
    def mesh(self) -> TexturedMesh | None:
        """The mesh; None without one."""
        return self.environment.mesh if self.environment.has_mesh else None

    @property
    def mapping_poses(self) -> Float | None:
        """Poses cam_from_world (M, 3, 4) of the mapping cameras; None if unknown."""
        return self.environment.mapping_poses

    @property
    def mapping_centers(self) -> Float:
        """Centres of the mapping cameras (M, 3), metres; empty if unknown."""
        return camera_centers(np.empty((0, 3, 4)) if self.mapping_poses is None else self.mapping_poses)

    @cached_property
    def space(self) -> Any:
        """Where a camera can be: `bounds` (2, 3) m and `is_free`."""
        return self.environment.space if self.environment.has_mesh else self.environment.mapped_space

    @property
    def occlusions(self) -> tuple[str, ...]:
        """Names of available occlusion models, the most accurate first."""
        return tuple(name for name in self.environment.available_occlusion if name != "tsdf")  # slow to make

    @cached_property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods that can score here, that of the best weights first."""
        return self.weights.methods

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Signs that the map is not in metres with z up, or that the mesh is in another frame."""
        from wheretolook.mapping.sanity import frame_warnings, mesh_warning

        warnings: tuple[str, ...] = ()
        if self.mapping_poses is not None and len(self.mapping_poses) > 0:
            warnings = frame_warnings(self.landmarks.mapping_distance_m, self.mapping_poses)
        if self.mesh is not None and (doubt := mesh_warning(self.landmarks.points, self.environment.raycaster)):
            warnings = (*warnings, f"The mesh: {doubt}")
        return warnings

    def picture(self, pose: Float, visible: VisibleLandmarks) -> tuple[drawing.Rgb, str]:
        """Return an image (H, W, 3) of a view (3, 4) and its caption.

        The view is rendered; without a mesh it is the nearest photograph, or else the landmarks alone. Landmarks are
        drawn in the colours of their probabilities, except on photographs, which show another view.
        """
        marks = (self.camera, visible.pixels, visible.probabilities)
        if self.environment.has_mesh:
            rgb = self.environment.renderer.render(drawing.small_camera(self.camera), pose[None]).rgb[0]
            return drawing.picture(rgb, *marks), "rendered; landmarks by detection probability"
        if self.photographs is not None:
            number = self.photographs.nearest(pose)
            rgb = self.photographs.read(number, drawing.PICTURE_PX)
            return rgb, f"nearest photograph, {self.photographs.names[number]}"
        return drawing.picture(None, *marks), "landmarks in view by detection probability"

    def localization_map(self, occlusion: str) -> LocalizationMap:
        """Return the map with an occlusion model. Raises ConfigError if the model is not available."""
        from wheretolook.inputs.localization_map import LocalizationMap
        from wheretolook.visibility.cached_occlusion import CachedOcclusion

        if occlusion not in self.occlusions:
            fix = f"Use {', '.join(self.occlusions)}."
            raise ConfigError("this occlusion model is not available here", value=occlusion, fix=fix)
        if occlusion not in self._maps:
            environment = self.environment
            model = environment.occlusion_model(occlusion)
            if occlusion != "none":
                model = CachedOcclusion(model, OCCLUSION_BYTES)
            self._maps[occlusion] = LocalizationMap(
                self.landmarks, self.camera, model, environment.device, self.mapping_poses
            )
        return self._maps[occlusion]

    def selector(self, method: str = "", occlusion: str = "", directions: int = DIRECTIONS) -> WhereToLook:
        """Return the view selector of a method (by default of the best weights) and an occlusion model.

        Scorers cache what depends on the directions, so each number of directions has its own. Raises ConfigError for
        an unknown method or occlusion model, WeightsError if the weights cannot be used.
        """
        from wheretolook.scorers.registry import check_method, make_scorer
        from wheretolook.select.where_to_look import WhereToLook

        key = (method or self.methods[0], occlusion or self.occlusions[0], directions)
        selector = self._selectors.pop(key, None)
        if selector is None:
            weights = self.weights.files.get(check_method(key[0]).weights)
            scorer = make_scorer(key[0], self.localization_map(key[1]), weights=weights)
            selector = WhereToLook(scorer, direction_lattice(directions), self.space)
            if len(self._selectors) >= MAX_SCORERS:
                del self._selectors[next(iter(self._selectors))]  # the least recently used
        self._selectors[key] = selector
        return selector


def open_map(
    path: Path,
    mesh: Path | None = None,
    camera: Camera | int | None = None,
    images: Path | None = None,
    weights: Path | None = None,
    device: str = "cpu",
    data: Path = Path("data"),
) -> ViewedMap:
    """Open a COLMAP model in metres with z up, a mesh in its frame, and the folder of its images.

    By default views are scored by weights adapted to the model in the folder `data`, or by bundled ones.

    Raises:
        MapError: the model cannot be used.
        SceneError: the mesh cannot be used.
        ConfigError: there is no such camera.
        WeightsError: the weights cannot be used.
    """
    from wheretolook.mapping.sanity import warn_of_mesh
    from wheretolook.mapping.sources import find_photographs
    from wheretolook.view.photographs import Photographs

    environment = ColmapEnvironment(ColmapFiles(path, mesh), camera, device=device)
    landmarks = environment.landmarks
    if len(landmarks) == 0:
        raise MapError("the map has no landmarks", path=path, fix="Map it again.")
    if weights is None:
        available = map_weights(path, data, landmarks.points, landmarks.features)
    else:
        available = given_weights(weights, landmarks.features)
    if mesh is not None:
        warn_of_mesh(mesh, landmarks.points, environment.raycaster)
    folder = images or find_photographs(path)
    photographs = None if folder is None else Photographs.of_model(path, folder)
    model = path.resolve()
    name = model.parent.name if model.name in ("0", "sparse", "map") else model.name
    return ViewedMap(name, environment, available, photographs=photographs)


def open_scene(
    files: SceneFolder, camera: Camera | None = None, weights: Path | None = None, device: str = "cpu"
) -> ViewedMap:
    """Open a mapped scene of a dataset, with its labels if there are any.

    By default views are scored by the scene's own weights (`scene_weights`), or by bundled ones. Raises MapError or
    TableError if the scene has not been mapped, WeightsError if the weights cannot be used.
    """
    from wheretolook.mapping.colmap_model import holds_model
    from wheretolook.mapping.sources import find_photographs
    from wheretolook.view.photographs import Photographs

    if not files.landmarks.is_file():
        raise MapError("this scene has no map yet", path=files.map, fix="Run `wheretolook map` for its dataset.")
    number, own_camera = next(iter(files.cameras().items()))
    environment = SceneEnvironment(files, camera or own_camera, EnvironmentConfig(assume_metric=True), device)
    if not environment.has_mesh and environment.mapping_poses is None:
        raise SceneError("neither a mesh nor the map's cameras are known", path=files.folder, fix="Map it again.")
    landmarks = environment.landmarks
    if weights is None:
        available = scene_weights(files, landmarks.points, landmarks.features)
    else:
        available = given_weights(weights, landmarks.features)
    folder = find_photographs(files.map)
    photographs = None
    if folder is not None and holds_model(files.map):
        photographs = Photographs.of_model(files.map, folder)
    labels = _labels(files, number) if camera is None else None
    return ViewedMap(files.name, environment, available, labels, photographs)


def _labels(files: SceneFolder, camera: int) -> pd.DataFrame | None:
    """Read the labelled viewpoints of a camera; None without any."""
    from wheretolook.dataset.viewpoint_table import CAMERA_ID, UNLABELLED

    if not files.table.is_file():
        return None
    table = files.read_table()
    if CAMERA_ID in table:
        table = table[table[CAMERA_ID] == camera]
    table = table[table["status"] != UNLABELLED].reset_index(drop=True)
    return None if table.empty else table


def open_named_scene(
    data: Path, name: str, dataset: str, camera: Camera | None, weights: Path | None, device: str
) -> ViewedMap:
    """Open the scene of a name in a folder of datasets; raises as `dataset.layout.find_scene` and `open_scene`."""
    from wheretolook.dataset.layout import find_scene

    if not data.is_dir():
        fix = "Make a scene first, such as by `wheretolook demo`, or name a model: --map SPARSE."
        raise TableError("there is no such folder of datasets", path=data, fix=fix)
    return open_scene(find_scene(data, name, dataset), camera, weights, device)
