"""What is looked at: a scene of a dataset, or a COLMAP map with or without a mesh. Each part is made once."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import ConfigError, MapError, SceneError, TableError
from wheretolook.view import drawing
from wheretolook.view.weights import KnownWeights, given_weights, map_weights, scene_weights
from wheretolook.visibility.config import OcclusionConfig

if TYPE_CHECKING:  # nothing that is imported here may load torch or Warp: the page is to be there before them
    import pandas as pd

    from wheretolook.dataset.layout import SceneFolder
    from wheretolook.geometry.mesh import TexturedMesh
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.mapping.landmarks import Landmarks
    from wheretolook.rendering.warp_renderer import WarpRenderer
    from wheretolook.select.where_to_look import WhereToLook
    from wheretolook.space.free_space import FreeSpace
    from wheretolook.view.photographs import Photographs
    from wheretolook.view.scores import SeenLandmarks
    from wheretolook.visibility.occlusion import OcclusionModel

MOST_SCORERS = 8  # that are kept: those of large maps take a hundred megabytes each
DIRECTIONS = 500
"""Directions around a clicked place, as `wheretolook select` looks along."""


@dataclass(eq=False)
class Opened:
    """A map, and what is known of the place it shows. World in metres, z up.

    `scorer_of` and everything else but plain attributes is for one thread.
    """

    name: str
    landmarks: Landmarks
    camera: Camera  # the one that looks
    mapping_poses: Float | None  # cam_from_world (M, 3, 4)
    weights: KnownWeights
    mesh: TexturedMesh | None = None
    camera_space: Any = None  # where a camera can be, if not what mesh or map alone tell
    labels: pd.DataFrame | None = None  # labelled viewpoints, if there are any
    photographs: Photographs | None = None  # those that the map was made from, if they lie here
    device: str = "cpu"
    _maps: dict[str, LocalizationMap] = field(default_factory=dict, init=False)
    _looks: dict[tuple[str, str, int], WhereToLook] = field(default_factory=dict, init=False)

    @property
    def occlusions(self) -> tuple[str, ...]:
        """Names of what can hide landmarks here, the best first."""
        return (*(("mesh",) if self.mesh is not None else ()), "hidden-points", "none")

    @cached_property
    def doubts(self) -> tuple[str, ...]:
        """Why it seems not to be in metres with z up, or the mesh not in its frame: the scores then say nothing."""
        from wheretolook.mapping.sanity import frame_doubts, mesh_doubt

        found: tuple[str, ...] = ()
        if self.mapping_poses is not None and len(self.mapping_poses) > 0:
            found = frame_doubts(self.landmarks.mapping_distance_m, self.mapping_poses)
        doubt = "" if self.mesh is None else mesh_doubt(self.landmarks.points, self._mesh_space.raycaster)
        return (*found, f"The mesh: {doubt}") if doubt else found

    @cached_property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods that can score here, that of the best weights first."""
        return self.weights.methods

    @cached_property
    def _mesh_space(self) -> FreeSpace:
        from wheretolook.space.free_space import FreeSpace

        assert self.mesh is not None
        return FreeSpace(self.mesh, device=self.device)

    @cached_property
    def space(self) -> Any:
        """Where a camera can be; `bounds` (2, 3) and `is_free`."""
        if self.camera_space is not None:
            return self.camera_space
        if self.mesh is not None:
            return self._mesh_space
        from wheretolook.space.mapped_space import MappedSpace

        return MappedSpace(self.landmarks.points, centers_of(self))

    @cached_property
    def renderer(self) -> WarpRenderer | None:
        """Renders the mesh, if there is one."""
        if self.mesh is None:
            return None
        from wheretolook.rendering.warp_renderer import WarpRenderer

        return WarpRenderer(self.mesh, self.device)

    def picture(self, pose: Float, seen: SeenLandmarks) -> tuple[drawing.Rgb, str]:
        """What a view (3, 4) shows, (H, W, 3), and what kind of picture it is: rendered, or the nearest photograph, or
        the landmarks alone.

        Landmarks in view are marked in the colours of their chances, but not on a photograph, which shows another view.
        """
        if self.renderer is not None:
            rgb = self.renderer.render(drawing.small_camera(self.camera), pose[None]).rgb[0]
            return drawing.picture(rgb, self.camera, seen.pixels, seen.chances), "rendered; landmarks by their chance"
        if self.photographs is not None:
            number = self.photographs.nearest(pose)
            rgb = self.photographs.read(number, drawing.PICTURE_PX)
            return rgb, f"nearest photograph, {self.photographs.names[number]}"
        return drawing.picture(None, self.camera, seen.pixels, seen.chances), "landmarks in view by their chance"

    def map_of(self, occlusion: str) -> LocalizationMap:
        """The map with what hides landmarks. Raises ConfigError if there is no such occlusion here."""
        from wheretolook.inputs.localization_map import LocalizationMap

        if occlusion not in self.occlusions:
            fix = f"There are {', '.join(self.occlusions)}."
            raise ConfigError("there is no such occlusion here", value=occlusion, fix=fix)
        if occlusion not in self._maps:
            hides = self._occlusion(occlusion)
            self._maps[occlusion] = LocalizationMap(self.landmarks, self.camera, hides, self.device, self.mapping_poses)
        return self._maps[occlusion]

    def look(self, method: str = "", occlusion: str = "", directions: int = DIRECTIONS) -> WhereToLook:
        """Scores views by a method (empty for the best weights), finds the best, as `wheretolook select` does.

        Each number of directions has a scorer of its own, since scorers keep what they know of the directions.

        Raises ConfigError if there is no such method or occlusion, WeightsError if its weights cannot be used.
        """
        from wheretolook.scorers.registry import check_method, make_scorer
        from wheretolook.select.where_to_look import WhereToLook

        method = method or self.methods[0]
        occlusion = occlusion or self.occlusions[0]
        key = (method, occlusion, directions)
        if key not in self._looks:
            weights = self.weights.files.get(check_method(method).weights)
            scorer = make_scorer(method, self.map_of(occlusion), weights=weights)
            self._looks[key] = WhereToLook(scorer, direction_lattice(directions), self.space)
            if len(self._looks) > MOST_SCORERS:
                del self._looks[next(iter(self._looks))]  # the one that was asked for longest ago
        self._looks[key] = self._looks.pop(key)
        return self._looks[key]

    def _occlusion(self, name: str) -> OcclusionModel:
        from wheretolook.visibility.cached_occlusion import RememberedOcclusion
        from wheretolook.visibility.hidden_points import HiddenPointRemoval
        from wheretolook.visibility.occlusion import MeshOcclusion, NoOcclusion

        config = OcclusionConfig()
        if name == "none":
            return NoOcclusion()
        if name == "mesh":
            space = self._mesh_space
            return RememberedOcclusion(
                MeshOcclusion(space.raycaster, config.margin_m, space.two_sided), REMEMBERED_BYTES
            )
        return RememberedOcclusion(HiddenPointRemoval(config.radius, config.margin_m), REMEMBERED_BYTES)


REMEMBERED_BYTES = 1 << 26
"""Lines of sight that are kept: of the places clicked last, and of a floor. Beyond that they are computed again."""


def open_map(
    path: Path,
    mesh: Path | None = None,
    camera: Camera | int | None = None,
    images: Path | None = None,
    weights: Path | None = None,
    device: str = "cpu",
    data: Path = Path("data"),
) -> Opened:
    """A COLMAP model in metres with z up, a mesh in its frame, and the folder of its photographs.

    Unless weights are given, those adapted to it score, which lie in the folder `data`, or those that ship.

    Raises MapError if there is no usable model, SceneError if the mesh cannot be used, ConfigError without such a
    camera, WeightsError if the weights cannot be used.
    """
    from wheretolook.mapping.opened_map import open_colmap
    from wheretolook.mapping.sanity import warn_of_mesh
    from wheretolook.mapping.sources import photographs_of
    from wheretolook.view.photographs import Photographs

    landmarks, camera, poses = open_colmap(path, camera)
    if len(landmarks) == 0:
        raise MapError("the map has no landmarks", path=path, fix="Map it again.")
    folder = images or photographs_of(path)
    shown = None if folder is None else Photographs.of_model(path, folder)
    name = path.resolve().parent.name if path.resolve().name in ("0", "sparse", "map") else path.resolve().name
    features = landmarks.features
    if weights is None:
        known = map_weights(path, data, landmarks.points, features)
    else:
        known = given_weights(weights, features)
    opened = Opened(name, landmarks, camera, poses, known, _mesh(mesh), photographs=shown, device=device)
    if mesh is not None:
        warn_of_mesh(mesh, landmarks.points, opened.space.raycaster)
    return opened


def open_scene(
    files: SceneFolder, camera: Camera | None = None, weights: Path | None = None, device: str = "cpu"
) -> Opened:
    """A scene of a dataset, as the map stage leaves it, with what later stages have added.

    Unless weights are given, its own score if it has any (`scene_weights`), or those that ship.

    Raises MapError or TableError if it is half made: `wheretolook map` has not been run; WeightsError if the weights
    cannot be used.
    """
    from wheretolook.dataset.environment import Scene, SceneConfig
    from wheretolook.dataset.viewpoint_table import CAMERA_ID, UNLABELLED
    from wheretolook.mapping.colmap_model import holds_model
    from wheretolook.mapping.sources import photographs_of
    from wheretolook.view.photographs import Photographs

    if not files.landmarks.is_file():
        fix = "Run `wheretolook map` for its dataset."
        raise MapError("this scene is half made: it has no map", path=files.map, fix=fix)
    number, own = next(iter(files.cameras().items()))
    scene = Scene(files, camera or own, SceneConfig(assume_metric=True), device)
    mesh = scene.mesh if files.mesh.is_file() else None
    space = scene.scanned_space if mesh is not None and files.is_scanned else None
    labels = None
    if files.table.is_file() and camera is None:
        table = files.read_table()
        if CAMERA_ID in table:
            table = table[table[CAMERA_ID] == number]
        labels = table[table["status"] != UNLABELLED].reset_index(drop=True)
    folder = photographs_of(files.map)
    shown = Photographs.of_model(files.map, folder) if folder is not None and holds_model(files.map) else None
    if mesh is None and scene.mapping_poses is None:
        raise SceneError("neither a mesh nor the map's cameras are known", path=files.folder, fix="Map it again.")
    points = scene.landmarks.points
    features = scene.landmarks.features
    known = scene_weights(files, points, features) if weights is None else given_weights(weights, features)
    return Opened(
        files.name, scene.landmarks, scene.camera, scene.mapping_poses, known, mesh, space,
        None if labels is None or labels.empty else labels, shown, scene.device,
    )  # fmt: skip


def find_opened(
    data: Path, name: str, dataset: str, camera: Camera | None, weights: Path | None, device: str
) -> Opened:
    """The scene of a name in a folder of datasets; raises as `wheretolook.holdout.photo_map.find_scene`, `open_scene`."""
    from wheretolook.holdout.photo_map import find_scene

    if not data.is_dir():
        fix = "Make a scene first, such as by `wheretolook demo`, or name a model: --map SPARSE."
        raise TableError("there is no such folder of datasets", path=data, fix=fix)
    return open_scene(find_scene(data, name, dataset), camera, weights, device)


def _mesh(path: Path | None) -> TexturedMesh | None:
    if path is None:
        return None
    from wheretolook.scenes.loading import load_mesh

    return load_mesh(path, colored=False)


def centers_of(opened: Opened) -> Float:
    """Places of the mapping cameras, (M, 3) metres; empty if they are not known."""
    from wheretolook.geometry.poses import camera_centers

    if opened.mapping_poses is None:
        return np.empty((0, 3))
    return camera_centers(opened.mapping_poses.astype(np.float64))
