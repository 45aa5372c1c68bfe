"""The map that the viewer shows: a scene of a dataset, or a COLMAP model with or without a mesh."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.utils.errors import ConfigError, MapError, SceneError, TableError
from wheretolook.view import drawing
from wheretolook.view.weights import AvailableWeights, given_weights, map_weights, scene_weights
from wheretolook.visibility.config import OcclusionConfig

if TYPE_CHECKING:  # torch and Warp are imported when first needed: the page opens before them
    import pandas as pd

    from wheretolook.dataset.layout import SceneFolder
    from wheretolook.geometry.mesh import TexturedMesh
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.mapping.landmarks import Landmarks
    from wheretolook.rendering.warp_renderer import WarpRenderer
    from wheretolook.select.where_to_look import WhereToLook
    from wheretolook.space.free_space import FreeSpace
    from wheretolook.view.photographs import Photographs
    from wheretolook.view.scores import VisibleLandmarks
    from wheretolook.visibility.occlusion import OcclusionModel

MAX_SCORERS = 8  # kept in memory; those of large maps take 100 MB each
DIRECTIONS = 500  # scored at a location, as by `wheretolook select`
OCCLUSION_BYTES = 1 << 26  # memory for cached lines of sight


@dataclass(eq=False)
class ViewedMap:
    """A map with everything that the viewer shows of it; world in metres, z up. Methods are not thread-safe."""

    name: str
    landmarks: Landmarks
    camera: Camera
    mapping_poses: Float | None  # cam_from_world (M, 3, 4)
    weights: AvailableWeights
    mesh: TexturedMesh | None = None
    camera_space: Any = None  # where a camera can be, if not defined by mesh or map
    labels: pd.DataFrame | None = None  # labelled viewpoints
    photographs: Photographs | None = None
    device: str = "cpu"
    _maps: dict[str, LocalizationMap] = field(default_factory=dict, init=False)
    _selectors: dict[tuple[str, str, int], WhereToLook] = field(default_factory=dict, init=False)

    @property
    def occlusions(self) -> tuple[str, ...]:
        """Names of available occlusion models, the most accurate first."""
        return (*(("mesh",) if self.mesh is not None else ()), "hidden-points", "none")

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Signs that the map is not in metres with z up, or that the mesh is in another frame."""
        from wheretolook.mapping.sanity import frame_doubts, mesh_doubt

        warnings: tuple[str, ...] = ()
        if self.mapping_poses is not None and len(self.mapping_poses) > 0:
            warnings = frame_doubts(self.landmarks.mapping_distance_m, self.mapping_poses)
        doubt = "" if self.mesh is None else mesh_doubt(self.landmarks.points, self._mesh_space.raycaster)
        return (*warnings, f"The mesh: {doubt}") if doubt else warnings

    @cached_property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods that can score here, that of the best weights first."""
        return self.weights.methods

    @property
    def mapping_centers(self) -> Float:
        """Centres of the mapping cameras (M, 3), metres; empty if unknown."""
        return camera_centers(np.empty((0, 3, 4)) if self.mapping_poses is None else self.mapping_poses)

    @cached_property
    def _mesh_space(self) -> FreeSpace:
        from wheretolook.space.free_space import FreeSpace

        assert self.mesh is not None
        return FreeSpace(self.mesh, device=self.device)

    @cached_property
    def space(self) -> Any:
        """Where a camera can be: `bounds` (2, 3) m and `is_free`."""
        if self.camera_space is not None:
            return self.camera_space
        if self.mesh is not None:
            return self._mesh_space
        from wheretolook.space.mapped_space import MappedSpace

        return MappedSpace(self.landmarks.points, self.mapping_centers)

    @cached_property
    def renderer(self) -> WarpRenderer | None:
        """Renders the mesh; None without one."""
        if self.mesh is None:
            return None
        from wheretolook.rendering.warp_renderer import WarpRenderer

        return WarpRenderer(self.mesh, self.device)

    def picture(self, pose: Float, visible: VisibleLandmarks) -> tuple[drawing.Rgb, str]:
        """Return an image (H, W, 3) of a view (3, 4) and its caption.

        The view is rendered; without a mesh it is the nearest photograph, or else the landmarks alone. Landmarks are
        drawn in the colours of their probabilities, except on photographs, which show another view.
        """
        marks = (self.camera, visible.pixels, visible.probabilities)
        if self.renderer is not None:
            rgb = self.renderer.render(drawing.small_camera(self.camera), pose[None]).rgb[0]
            return drawing.picture(rgb, *marks), "rendered; landmarks by detection probability"
        if self.photographs is not None:
            number = self.photographs.nearest(pose)
            rgb = self.photographs.read(number, drawing.PICTURE_PX)
            return rgb, f"nearest photograph, {self.photographs.names[number]}"
        return drawing.picture(None, *marks), "landmarks in view by detection probability"

    def localization_map(self, occlusion: str) -> LocalizationMap:
        """Return the map with an occlusion model. Raises ConfigError if the model is not available."""
        from wheretolook.inputs.localization_map import LocalizationMap

        if occlusion not in self.occlusions:
            fix = f"Use {', '.join(self.occlusions)}."
            raise ConfigError("this occlusion model is not available here", value=occlusion, fix=fix)
        if occlusion not in self._maps:
            model = self._occlusion_model(occlusion)
            self._maps[occlusion] = LocalizationMap(self.landmarks, self.camera, model, self.device, self.mapping_poses)
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

    def _occlusion_model(self, name: str) -> OcclusionModel:
        from wheretolook.visibility.cached_occlusion import CachedOcclusion
        from wheretolook.visibility.hidden_points import HiddenPointRemoval
        from wheretolook.visibility.occlusion import MeshOcclusion, NoOcclusion

        config = OcclusionConfig()
        if name == "none":
            return NoOcclusion()
        if name == "mesh":
            space = self._mesh_space
            model: OcclusionModel = MeshOcclusion(space.raycaster, config.margin_m, space.two_sided)
        else:
            model = HiddenPointRemoval(config.radius, config.margin_m)
        return CachedOcclusion(model, OCCLUSION_BYTES)


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
    from wheretolook.mapping.opened_map import open_colmap
    from wheretolook.mapping.sanity import warn_of_mesh
    from wheretolook.mapping.sources import photographs_of
    from wheretolook.scenes.loading import load_mesh
    from wheretolook.view.photographs import Photographs

    landmarks, camera, poses = open_colmap(path, camera)
    if len(landmarks) == 0:
        raise MapError("the map has no landmarks", path=path, fix="Map it again.")
    folder = images or photographs_of(path)
    place = path.resolve()
    viewed = ViewedMap(
        place.parent.name if place.name in ("0", "sparse", "map") else place.name,
        landmarks,
        camera,
        poses,
        map_weights(path, data, landmarks.points, landmarks.features)
        if weights is None
        else given_weights(weights, landmarks.features),
        None if mesh is None else load_mesh(mesh, colored=False),
        photographs=None if folder is None else Photographs.of_model(path, folder),
        device=device,
    )
    if mesh is not None:
        warn_of_mesh(mesh, landmarks.points, viewed.space.raycaster)
    return viewed


def open_scene(
    files: SceneFolder, camera: Camera | None = None, weights: Path | None = None, device: str = "cpu"
) -> ViewedMap:
    """Open a mapped scene of a dataset, with its labels if there are any.

    By default views are scored by the scene's own weights (`scene_weights`), or by bundled ones. Raises MapError or
    TableError if the scene has not been mapped, WeightsError if the weights cannot be used.
    """
    from wheretolook.dataset.environment import EnvironmentConfig, SceneEnvironment
    from wheretolook.dataset.viewpoint_table import CAMERA_ID, UNLABELLED
    from wheretolook.mapping.colmap_model import holds_model
    from wheretolook.mapping.sources import photographs_of
    from wheretolook.view.photographs import Photographs

    if not files.landmarks.is_file():
        raise MapError("this scene has no map yet", path=files.map, fix="Run `wheretolook map` for its dataset.")
    number, own_camera = next(iter(files.cameras().items()))
    scene = SceneEnvironment(files, camera or own_camera, EnvironmentConfig(assume_metric=True), device)
    mesh = scene.mesh if files.mesh.is_file() else None
    if mesh is None and scene.mapping_poses is None:
        raise SceneError("neither a mesh nor the map's cameras are known", path=files.folder, fix="Map it again.")
    labels = None
    if files.table.is_file() and camera is None:
        table = files.read_table()
        if CAMERA_ID in table:
            table = table[table[CAMERA_ID] == number]
        table = table[table["status"] != UNLABELLED].reset_index(drop=True)
        labels = None if table.empty else table
    folder = photographs_of(files.map)
    landmarks = scene.landmarks
    return ViewedMap(
        files.name,
        landmarks,
        scene.camera,
        scene.mapping_poses,
        scene_weights(files, landmarks.points, landmarks.features)
        if weights is None
        else given_weights(weights, landmarks.features),
        mesh,
        scene.scanned_space if mesh is not None and files.is_scanned else None,
        labels,
        Photographs.of_model(files.map, folder) if folder is not None and holds_model(files.map) else None,
        scene.device,
    )


def open_named_scene(
    data: Path, name: str, dataset: str, camera: Camera | None, weights: Path | None, device: str
) -> ViewedMap:
    """Open the scene of a name in a folder of datasets; raises as `holdout.photo_map.find_scene` and `open_scene`."""
    from wheretolook.holdout.photo_map import find_scene

    if not data.is_dir():
        fix = "Make a scene first, such as by `wheretolook demo`, or name a model: --map SPARSE."
        raise TableError("there is no such folder of datasets", path=data, fix=fix)
    return open_scene(find_scene(data, name, dataset), camera, weights, device)
