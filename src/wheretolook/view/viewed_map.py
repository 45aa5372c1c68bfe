"""The map that the viewer shows, its weights, and scores of a floor, a location and labelled views."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from scipy.spatial import cKDTree

from wheretolook.dataset.layout import Dataset, SceneFolder, find_scene
from wheretolook.dataset.scene import ColmapFiles, Scene
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.geometry.views import Views
from wheretolook.mapping.config import FrameOptions, place_name
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map_frame import IDENTITY, mesh_warning
from wheretolook.scorers.registry import check_method, make_scorer, scorers
from wheretolook.scorers.weights import resolve_weights, weights_by_method
from wheretolook.utils.errors import MapError, TableError, WhereToLookError
from wheretolook.utils.package import WEIGHTS, or_shipped, shipped
from wheretolook.view import drawing
from wheretolook.view.state import Paths, ViewState

if TYPE_CHECKING:  # torch and Warp are imported when first needed: the page opens before them
    import pandas as pd

    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.scorers.base import Scorer
    from wheretolook.select.where_to_look import WhereToLook


FIRST_CELLS = 12  # scored before a floor is drawn

CACHE_BYTES = 1 << 26  # memory for lines of sight
BLOCK = 1 << 10  # labelled views scored per step
MAX_SCORERS = 8  # kept in memory; those of large maps take 100 MB each


@dataclass(eq=False)
class Floor:
    """Free cells of a horizontal grid, and the best score in each once computed."""

    selector: WhereToLook  # scores the cells in its directions
    height_m: float
    lower: Float  # (2,) m, corner of the grid
    cell_m: float
    shape: tuple[int, int]  # rows along y, columns along x
    cells: NDArray[np.int64]  # (K,) flat indices of free cells, in farthest-first order
    drawn_m: float  # height at which the floor is drawn
    scores: Float = field(init=False)  # (K,) NaN until computed
    axes: Float = field(init=False)  # (K, 3) best directions
    n_scored: int = 0

    def __post_init__(self) -> None:
        self.scores = np.full(len(self.cells), np.nan)
        self.axes = np.full((len(self.cells), 3), np.nan)

    @property
    def points(self) -> Float:
        """Centres of the free cells (K, 3), metres."""
        rows, columns = np.divmod(self.cells, self.shape[1])
        xy = self.lower + (np.stack([columns, rows], axis=1) + 0.5) * self.cell_m
        return np.column_stack([xy, np.full(len(xy), self.height_m)])

    def score_next(self, n: int) -> bool:
        """Score the next n cells. Returns whether any were left."""
        rows = slice(self.n_scored, min(self.n_scored + n, len(self.cells)))
        if rows.start == rows.stop:
            return False
        scores = self.selector.scorer.score_directions(self.points[rows], self.selector.directions)
        self.scores[rows] = scores.max(axis=1)
        self.axes[rows] = self.selector.directions[scores.argmax(axis=1)]
        self.n_scored = rows.stop
        return True

    def raster(self) -> Float:
        """Return scores (rows, columns), NaN outside free space; cells not yet scored have the nearest one's score."""
        values = np.full(self.shape, np.nan)
        if self.n_scored:
            _, nearest = cKDTree(self.points[: self.n_scored]).query(self.points)
            values.flat[self.cells] = self.scores[nearest]
        return values


def floor_at(selector: WhereToLook, height_m: float) -> Floor:
    """Make the floor of the free cells at a height of the selector's space, without those inside geometry.

    It is drawn on the ground if its height is known, where it hides less than at the camera's height.
    """
    space = selector.space
    low, high = np.asarray(space.bounds, dtype=np.float64)[:, :2]
    cell = max(0.1, float(np.sqrt(np.prod(high - low) / 1200)))
    columns, rows = (max(1, ceil(length)) for length in (high - low) / cell)
    lower = (low + high) / 2 - np.array([columns, rows]) * cell / 2
    floor = Floor(selector, height_m, lower, cell, (rows, columns), np.arange(rows * columns), height_m)
    free = space.is_free(floor.points)
    free[free] = ~selector.localization_map.occlusion.inside_geometry(floor.points[free])
    cells = np.flatnonzero(free)
    drawn_m = height_m
    if len(cells) and hasattr(space, "floor_below"):
        drawn_m = float(np.median(space.floor_below(floor.points[cells]))) + 0.03  # above carpets
    order = farthest_first(np.stack(np.divmod(cells, columns), axis=1))
    return Floor(selector, height_m, lower, cell, (rows, columns), cells[order], drawn_m)


def farthest_first(points: NDArray[np.int64]) -> NDArray[np.int64]:
    """Order points (K, 2) from a central one, each the farthest from all before it; indices (K,).

    The first n cover the rest within twice the optimal distance (Gonzalez, "Clustering to minimize the maximum
    intercluster distance", 1985).
    """
    order = np.zeros(len(points), dtype=np.int64)
    distance = -((points - points.mean(axis=0)) ** 2).sum(1) if len(points) else np.empty(0)
    for k in range(len(points)):
        order[k] = distance.argmax()
        to_new = ((points - points[order[k]]) ** 2).sum(1)
        distance = to_new if k == 0 else np.minimum(distance, to_new)
        distance[order[k]] = -1
    return order


@dataclass(frozen=True, eq=False)
class ScoredLocation:
    """A location with the score of each direction and its best views."""

    position: Float  # (3,) m
    directions: Float  # (D, 3) unit optical axes
    scores: Float  # (D,)
    best: Views  # best first


def score_location(selector: WhereToLook, position: Float, n: int) -> ScoredLocation:
    """Score all directions at a position (3,) m and select the n best views, as `wheretolook select` does.

    Raises TableError if the position is outside the map or inside geometry.
    """
    best = selector.best(position[None], n)
    scores = selector.scorer.score_directions(position[None], selector.directions)[0]
    return ScoredLocation(position, selector.directions, scores, best)


def score_in_blocks(scorer: Scorer, cam_from_world: Float) -> Generator[None, None, Float]:
    """Score poses (B, 3, 4) block by block; the generator returns the scores (B,)."""
    scores = np.empty(len(cam_from_world))
    for begin in range(0, len(scores), BLOCK):
        rows = slice(begin, begin + BLOCK)
        scores[rows] = scorer.score(cam_from_world[rows])
        yield
    return scores


class AvailableWeights:
    """Weights files and their origin, by the method that they belong to; the preferred method comes first.

    Made from existing files or folders by origin, followed by the bundled weights, for a map with `features`. Raises
    WeightsError if they cannot be used.
    """

    def __init__(self, features: str, own: Mapping[str, Path | None]) -> None:
        self.files: dict[str, Path] = {}
        self.origins: dict[str, str] = {}
        for origin, place in {**own, "bundled with wheretolook": shipped(WEIGHTS)}.items():
            for method, path in weights_by_method(place, features).items() if place is not None else ():
                if method not in self.files:
                    self.files[method] = path
                    self.origins[method] = origin

    def describe(self, method: str) -> str:
        """Describe the weights that a method scores with; empty for a method without weights."""
        kind = scorers()[method].weights
        return f"weights {self.origins[kind]}: {self.files[kind].name}" if kind in self.files else ""

    @property
    def methods(self) -> tuple[str, ...]:
        """Methods that can score with these weights or without any, the preferred one first."""
        usable = [
            name
            for name, method in scorers().items()
            if name != "random" and (not method.weights or method.weights in self.files)
        ]
        first = next(iter(self.files), "")
        return tuple(sorted(usable, key=lambda name: (scorers()[name].weights != first, name != first)))


def scene_weights(files: SceneFolder, landmarks: Landmarks) -> dict[str, Path | None]:
    """Find weights adapted to a scene and those trained with its dataset."""
    root = files.folder.parent
    trained = None
    if any((root / "weights").glob("*.safetensors")):
        trained = resolve_weights(dataset=Dataset.load(root))
        if trained is not None and not trained.is_relative_to(root):
            trained = None
    adapted = _if_adapted_to(root / "adapted" / f"{files.name}.safetensors", landmarks)
    return {"adapted to this scene": adapted, "trained with this dataset": trained}


def map_weights(model: Path, data: Path, landmarks: Landmarks) -> dict[str, Path | None]:
    """Find weights adapted to a COLMAP model by `wheretolook adapt --map`."""
    path = data / "checks" / place_name(model) / "adapted.safetensors"
    return {"adapted to this scene": _if_adapted_to(path, landmarks)}


def _if_adapted_to(path: Path, landmarks: Landmarks) -> Path | None:
    """Return the path if the file has weights adapted to a scene with these landmarks."""
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="np") as file:
            place = file.get_tensor("place")
    except (SafetensorError, OSError):
        return None
    from wheretolook.scorers.adapted.score import MIN_SHARE, share_of_place  # loads PyTorch

    return path if share_of_place(place, landmarks.points) >= MIN_SHARE else None


class ViewedMap:
    """A scene with everything else that the viewer shows, computed once for all clients.

    `own_weights` are files or folders by their origin, see `AvailableWeights`. Scorers, floors and landmarks in view
    are for one thread only.
    """

    def __init__(
        self, name: str, scene: Scene, own_weights: Mapping[str, Path | None], labels: pd.DataFrame | None = None
    ) -> None:
        self.name = name
        self.scene = scene
        self.weights = AvailableWeights(scene.landmarks.features, own_weights)
        self.labels = labels  # labelled viewpoints
        self.paths: Paths = {}  # to show
        self.landmarks = scene.landmarks
        self.camera = scene.camera
        self.frame = scene.frame  # the map's own, of coordinates that are read, shown or saved
        self.mapping_poses = scene.map.mapping_poses  # (M, 3, 4) cam_from_world
        self.mesh = scene.mesh if scene.has_mesh else None
        self.space = scene.space if scene.has_mesh else scene.mapped_space
        self.occlusions = tuple(name for name in scene.available_occlusion if name != "tsdf")  # slow to make
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
        warnings: tuple[str, ...] = ()
        if self.mapping_poses is not None and len(self.mapping_poses):
            warnings = self.scene.frame.messages(self.landmarks.mapping_distance_m, self.mapping_poses)
        if self.mesh is not None and (doubt := mesh_warning(self.landmarks.points, self.scene.raycaster)):
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
        return check_method(method).probability

    def score_range(self, method: str, scores: Float) -> tuple[float, float]:
        """Return the ends of the colour scale: 0 and 1 for probabilities, else those of the finite scores."""
        return (0.0, 1.0) if self.is_probability(method) else (float(np.nanmin(scores)), float(np.nanmax(scores)))

    # caches are shared by all maps of a process: usually it shows one

    @lru_cache(MAX_SCORERS)  # noqa: B019
    def selector(self, method: str, occlusion: str, directions: int = 500) -> WhereToLook:  # as by `wheretolook select`
        """Return the view selector of a method and an occlusion model.

        Scorers cache what depends on the directions, so each number of directions has its own. Raises ConfigError for
        an unknown method or occlusion model, WeightsError if the weights cannot be used.
        """
        weights = self.weights.files.get(check_method(method).weights)
        scorer = make_scorer(method, self._localization_map(occlusion), weights=weights)
        from wheretolook.select.where_to_look import WhereToLook  # loads PyTorch: the page opens before it does

        return WhereToLook(scorer, direction_lattice(directions), self.space)

    @lru_cache(MAX_SCORERS)  # noqa: B019
    def _localization_map(self, occlusion: str) -> LocalizationMap:
        opened = self.scene.with_occlusion(self.scene.occlusion_model(occlusion))
        return replace(opened, map=replace(opened.map, frame=IDENTITY))  # the viewer selects in the world

    @lru_cache(64)  # noqa: B019
    def floor(self, method: str, occlusion: str, height_m: float) -> Floor:
        """Return the floor at a height, one object for all clients."""
        # 19 degrees apart: the best score is within 0.02 of that of 500, in a third of the time
        return floor_at(self.selector(method, occlusion, 96), height_m)

    @lru_cache(4)  # noqa: B019
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
            rgb = self.scene.renderer.render(drawing.small_camera(self.camera), pose[None]).rgb[0]
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
    mesh_up: str = "z",
) -> ViewedMap:
    """Open a COLMAP model and a mesh in its frame.

    By default views are scored by weights adapted to the model in the folder `data`, or by bundled ones.

    Raises:
        MapError: the model cannot be used.
        SceneError: the mesh cannot be used.
        ConfigError: there is no such camera.
        WeightsError: the weights cannot be used.
    """
    scene = Scene.of_colmap(
        ColmapFiles(path, mesh, frame=frame, mesh_up=mesh_up), camera, device=device, cache_bytes=CACHE_BYTES
    )
    landmarks = scene.landmarks
    if len(landmarks) == 0:
        raise MapError("the map has no landmarks", path=path, fix="Map it again.")
    if mesh is not None:
        _ = scene.mesh_space  # raises or warns before the page is served
    own = {"given": or_shipped(weights)} if weights else map_weights(path, data, landmarks)
    return ViewedMap(scene.name, scene, own)


def open_scene(
    data: Path, name: str, dataset: str, camera: Camera | None, weights: Path | None, device: str
) -> ViewedMap:
    """Open a mapped scene of a dataset in the folder `data`, with its labels if there are any.

    By default views are scored by the scene's own weights (`scene_weights`), or by bundled ones. Raises as
    `dataset.layout.find_scene`, MapError or TableError if the scene has not been mapped, WeightsError if the weights
    cannot be used.
    """
    if not data.is_dir():
        fix = "Make a scene first, such as by `wheretolook demo`, or name a model: --map SPARSE."
        raise TableError("there is no such folder of datasets", path=data, fix=fix)
    files = find_scene(data, name, dataset)
    if not files.landmarks.is_file():
        raise MapError("this scene has no map yet", path=files.map, fix="Run `wheretolook map` for its dataset.")
    number, own_camera = next(iter(files.cameras().items()))
    scene = Scene(files, camera or own_camera, device=device, cache_bytes=CACHE_BYTES)
    landmarks = scene.landmarks
    own = {"given": or_shipped(weights)} if weights else scene_weights(files, landmarks)
    labels = None
    if camera is None and files.table.is_file():
        table = files.read_table()
        from wheretolook.dataset.viewpoint_table import CAMERA_ID, UNLABELLED

        shown = table["status"] != UNLABELLED
        if CAMERA_ID in table:
            shown &= table[CAMERA_ID] == number
        labels = table[shown].reset_index(drop=True) if shown.any() else None
    return ViewedMap(files.name, scene, own, labels)
