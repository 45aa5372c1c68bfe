"""The map that the viewer shows: a scene of a dataset, or a COLMAP model with or without a mesh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

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
from wheretolook.mapping.config import FrameOptions
from wheretolook.utils.errors import MapError, TableError, WhereToLookError
from wheretolook.utils.shipped import or_shipped
from wheretolook.view import drawing
from wheretolook.view.paths import Paths
from wheretolook.view.scores import FLOOR_DIRECTIONS, Floor, floor_at
from wheretolook.view.state import ViewState
from wheretolook.view.weights import AvailableWeights, map_weights, scene_weights

if TYPE_CHECKING:  # torch and Warp are imported when first needed: the page opens before them
    import pandas as pd

    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.scorers.base import Scorer
    from wheretolook.select.where_to_look import WhereToLook

MAX_SCORERS = 8  # kept in memory; those of large maps take 100 MB each
MAX_FLOORS = 64
MAX_MESHES = 4
DIRECTIONS = 500  # scored at a location, as by `wheretolook select`
OCCLUSION_BYTES = 1 << 26  # memory for cached lines of sight


class ViewedMap:
    """An environment with everything else that the viewer shows, computed once for all clients.

    `own_weights` are files or folders by their origin, see `AvailableWeights`. Scorers, floors and landmarks in view
    are for one thread only.
    """

    def __init__(
        self,
        name: str,
        environment: Environment,
        own_weights: Mapping[str, Path | None],
        labels: pd.DataFrame | None = None,
    ) -> None:
        self.name = name
        self.environment = environment
        self.weights = AvailableWeights(environment.landmarks.features, own_weights)
        self.labels = labels  # labelled viewpoints
        self.paths: Paths = {}  # to show
        self.landmarks = environment.landmarks
        self.camera = environment.camera
        self.frame = environment.frame  # the map's own, of coordinates that are read, shown or saved
        self.mapping_poses = environment.mapping_poses  # (M, 3, 4) cam_from_world
        self.mesh = environment.mesh if environment.has_mesh else None
        self.space = environment.space if environment.has_mesh else environment.mapped_space
        self.occlusions = tuple(name for name in environment.available_occlusion if name != "tsdf")  # slow to make
        self.bounds = np.array(self.space.bounds, dtype=np.float64)  # (2, 3) m, of free space
        self.landmark_bounds = np.quantile(self.landmarks.points, (0.02, 0.98), axis=0)  # without outliers
        self.size_m = float(np.linalg.norm(np.diff(self.landmark_bounds, axis=0)))
        self.marker_m = min(0.3, 0.03 * self.size_m)  # size of drawn markers
        low, high = self.bounds[:, 2]
        self.usual_m = float((low + high) / 2)  # median height of the mapping cameras
        if self.mapping_poses is not None and len(self.mapping_poses):
            self.usual_m = float(np.clip(np.median(camera_centers(self.mapping_poses)[:, 2]), low, high))

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """What was assumed or seems wrong of the map's unit and direction up, and signs that the mesh is in another frame."""
        from wheretolook.mapping.map_frame import mesh_warning

        warnings: tuple[str, ...] = ()
        if self.mapping_poses is not None and len(self.mapping_poses):
            warnings = self.environment.frame.messages(self.landmarks.mapping_distance_m, self.mapping_poses)
        if self.mesh is not None and (doubt := mesh_warning(self.landmarks.points, self.environment.raycaster)):
            warnings = (*warnings, f"The mesh: {doubt}")
        return warnings

    def complete(self, state: ViewState) -> ViewState:
        """Fill in method, occlusion model and height where a state leaves them open or they are not available."""
        return replace(
            state,
            method=state.method if state.method in self.weights.methods else self.weights.methods[0],
            occlusion=state.occlusion if state.occlusion in self.occlusions else self.occlusions[0],
            height=self.usual_m if state.height is None else state.height,
        )

    def is_probability(self, method: str) -> bool:
        """Test whether a method's scores are probabilities, which a threshold applies to."""
        from wheretolook.scorers.registry import check_method

        return check_method(method).probability

    def score_range(self, method: str, scores: Float) -> tuple[float, float]:
        """Return the ends of the colour scale: 0 and 1 for probabilities, else those of the finite scores."""
        return (0.0, 1.0) if self.is_probability(method) else (float(np.nanmin(scores)), float(np.nanmax(scores)))

    # caches are shared by all maps of a process: usually it shows one

    @lru_cache(MAX_SCORERS)  # noqa: B019
    def selector(self, method: str, occlusion: str, directions: int = DIRECTIONS) -> WhereToLook:
        """Return the view selector of a method and an occlusion model.

        Scorers cache what depends on the directions, so each number of directions has its own. Raises ConfigError for
        an unknown method or occlusion model, WeightsError if the weights cannot be used.
        """
        from wheretolook.scorers.registry import check_method, make_scorer
        from wheretolook.select.where_to_look import WhereToLook

        weights = self.weights.files.get(check_method(method).weights)
        scorer = make_scorer(method, self._localization_map(occlusion), weights=weights)
        return WhereToLook(scorer, direction_lattice(directions), self.space)

    @lru_cache(MAX_SCORERS)  # noqa: B019
    def _localization_map(self, occlusion: str) -> LocalizationMap:
        from wheretolook.inputs.localization_map import LocalizationMap

        model = self.environment.occlusion_model(occlusion)
        of_map = self.landmarks, self.camera, model, self.environment.device, self.mapping_poses
        # without the map's own frame: the viewer selects in the world
        photographs = self.environment.has_photographs
        return LocalizationMap(*of_map, photographs=photographs, images=self.environment.images)

    @lru_cache(MAX_FLOORS)  # noqa: B019
    def floor(self, method: str, occlusion: str, height_m: float) -> Floor:
        """Return the floor at a height, one object for all clients."""
        return floor_at(self.selector(method, occlusion, FLOOR_DIRECTIONS), height_m)

    @lru_cache(MAX_MESHES)  # noqa: B019
    def mesh_glb(self, cut_m: float | None) -> bytes | None:
        """Return the mesh below a height as GLB; None without a mesh."""
        return None if self.mesh is None else drawing.mesh_glb(self.mesh, cut_m)

    def visible_landmarks(self, method: str, occlusion: str, pose: Float) -> drawing.VisibleLandmarks:
        """Return the landmarks visible in a view (3, 4) with detection probabilities.

        Methods without landmark probabilities have those of the best weights, if these can score here.
        """
        scorer = self.selector(method, occlusion).scorer
        estimated = scorer.landmark_probabilities(pose[None])
        if estimated is None and (best := self._best_scorer(occlusion)) is not None:
            estimated = best.landmark_probabilities(pose[None])
        localization_map = scorer.localization_map
        if estimated is None:
            rows = localization_map.landmarks_in_view(pose[None])[0].astype(np.int64)
            probabilities = np.full(len(rows), np.nan)
        else:
            rows = estimated.rows
            probabilities = estimated.p_detect
        points = localization_map.landmarks.points[rows]
        pixels = localization_map.camera.project(points @ pose[:, :3].T + pose[:, 3])
        return drawing.VisibleLandmarks(points, pixels, probabilities)

    def _best_scorer(self, occlusion: str) -> Scorer | None:
        try:
            return self.selector(self.weights.methods[0], occlusion).scorer
        except WhereToLookError:  # such as weights of another field of view
            return None

    def picture(self, pose: Float, visible: drawing.VisibleLandmarks) -> tuple[drawing.Rgb, str]:
        """Return an image (H, W, 3) of a view (3, 4) and its caption.

        The view is rendered; without a mesh it is the landmarks alone. Landmarks are drawn in the colours of their
        probabilities.
        """
        if self.mesh is not None:
            rgb = self.environment.renderer.render(drawing.small_camera(self.camera), pose[None]).rgb[0]
            return drawing.picture(rgb, self.camera, visible), "rendered; landmarks by detection probability"
        return drawing.picture(None, self.camera, visible), "landmarks in view by detection probability"


def open_map(
    path: Path,
    mesh: Path | None = None,
    camera: Camera | int | None = None,
    weights: Path | None = None,
    device: str = "cpu",
    data: Path = Path("data"),
    frame: FrameOptions = FrameOptions(),
) -> ViewedMap:
    """Open a COLMAP model and a mesh in its frame.

    By default views are scored by weights adapted to the model in the folder `data`, or by bundled ones.

    Raises:
        MapError: the model cannot be used.
        SceneError: the mesh cannot be used.
        ConfigError: there is no such camera.
        WeightsError: the weights cannot be used.
    """
    from wheretolook.mapping.map_frame import warn_of_mesh

    config = EnvironmentConfig(occlusion_cache_bytes=OCCLUSION_BYTES)
    environment = ColmapEnvironment(ColmapFiles(path, mesh, frame=frame), camera, config=config, device=device)
    landmarks = environment.landmarks
    if len(landmarks) == 0:
        raise MapError("the map has no landmarks", path=path, fix="Map it again.")
    if mesh is not None:
        warn_of_mesh(mesh, landmarks.points, environment.raycaster)
    own = {"given": or_shipped(weights)} if weights else map_weights(path, data, landmarks)
    return ViewedMap(environment.name, environment, own)


def open_scene(
    data: Path, name: str, dataset: str, camera: Camera | None, weights: Path | None, device: str
) -> ViewedMap:
    """Open a mapped scene of a dataset in the folder `data`, with its labels if there are any.

    By default views are scored by the scene's own weights (`scene_weights`), or by bundled ones. Raises as
    `dataset.layout.find_scene`, MapError or TableError if the scene has not been mapped, WeightsError if the weights
    cannot be used.
    """
    from wheretolook.dataset.layout import find_scene
    from wheretolook.dataset.viewpoint_table import CAMERA_ID, UNLABELLED

    if not data.is_dir():
        fix = "Make a scene first, such as by `wheretolook demo`, or name a model: --map SPARSE."
        raise TableError("there is no such folder of datasets", path=data, fix=fix)
    files = find_scene(data, name, dataset)
    if not files.landmarks.is_file():
        raise MapError("this scene has no map yet", path=files.map, fix="Run `wheretolook map` for its dataset.")
    number, own_camera = next(iter(files.cameras().items()))
    config = EnvironmentConfig(occlusion_cache_bytes=OCCLUSION_BYTES)
    environment = SceneEnvironment(files, camera or own_camera, config, device)
    landmarks = environment.landmarks
    own = {"given": or_shipped(weights)} if weights else scene_weights(files, landmarks)
    labels = None
    if camera is None and files.table.is_file():
        table = files.read_table()
        shown = table["status"] != UNLABELLED
        if CAMERA_ID in table:
            shown &= table[CAMERA_ID] == number
        labels = table[shown].reset_index(drop=True) if shown.any() else None
    return ViewedMap(files.name, environment, own, labels)
