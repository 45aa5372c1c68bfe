"""One round of the benchmark in a scene: select views, render them, localize the images, score. Every step resumes."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.geometry.camera import PinholeCamera, cameras_by_id
from wheretolook.geometry.lattices import Lattice
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import Float, pose_error
from wheretolook.localization.config import LocalizerConfig, versions
from wheretolook.localization.localizer import Localizer
from wheretolook.mapping.colmap_model import MODEL_FILES, colmap_poses, model_arrays, read_model
from wheretolook.mapping.config import PARTNERS, MapConfig
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map_folder import DATABASE_FILE, MapDraft, MapRun, finish_map
from wheretolook.mapping.triangulation import (
    choose_pairs,
    extract_with_colors,
    posed_model,
    shrink_depth,
    surface_overlap,
    triangulate_model,
)
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.rendering.warp_renderer import Renderer, WarpRenderer
from wheretolook.scenes.loading import load_mesh
from wheretolook.scorers.registry import check_method
from wheretolook.scorers.weights import resolve_weights
from wheretolook.select.waypoints import Waypoints, read_waypoints
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.utils.errors import MapError, SceneError, StorageError, TableError
from wheretolook.utils.files import ArtifactCache, atomic_folder, cache_key, fingerprint, read_image, write_bytes
from wheretolook.utils.package import VERSION
from wheretolook.utils.processes import WorkerPool
from wheretolook_paper.benchmark.actloc_baseline import ACTLOC, ACTLOC_FIXED, MAX_ERROR_PX, actloc_views
from wheretolook_paper.benchmark.files import (
    CAMERA,
    DRAWN_CAMERA,
    IMAGE_ENDING,
    BenchmarkScene,
    PoseFile,
    read_errors,
    read_poses,
    write_errors,
    write_poses,
)
from wheretolook_paper.benchmark.report import Result, Scores

POSES = "selected_gt_poses.txt"
IMAGES = "images"
ERRORS = "pose_errors.txt"
ESTIMATES = "estimate_poses.txt"
"""Files in a method's folder, named as by the benchmark's scripts."""

BEST = "best"  # stands for the method of the weights
MAP_FOLDER = "map"
CACHE = "made-from.json"
STEPS = ("select", "localize")
BATCH = 16  # images rendered, or localized, at a time
LOCALIZER = LocalizerConfig(max_error_px=12.0)  # RANSAC's threshold in match_and_localize.py


@dataclass(frozen=True)
class RoundConfig:
    """Options of selecting and localizing views."""

    weights: Path | None = None  # file or folder; None for the bundled ones
    directions: int = 500
    lattice: Lattice = "fibonacci"
    max_turn_deg: float | None = None  # largest rotation between consecutive waypoints
    localize: bool = True  # False: errors are read from files of the benchmark's own script
    workers: int = 1
    device: str = "cpu"


class SceneRound:
    """A scene's round in a folder: a subfolder for each method, and `map/` for all.

    `messages` collects what a user should know: omitted waypoints, methods without errors yet.
    """

    def __init__(self, scene: BenchmarkScene, folder: Path, config: RoundConfig) -> None:
        self.scene = scene
        self.folder = folder
        self.config = config
        self.waypoints = _checked(read_waypoints(scene.waypoints))
        if config.localize and not (folder / MAP_FOLDER / CACHE).is_file() and not scene.images.is_dir():
            fix = "Put the images of the map there, or localize with the benchmark's own script: --localizer none."
            raise MapError("the images of the map are missing", path=scene.images, fix=fix)
        self.messages: list[str] = []

    def run(self, method: str) -> Scores | None:
        """Do the missing steps of a method: a registered name, `BEST` or `ACTLOC`.

        Returns None if the benchmark's own script localizes and has not written its errors yet. Raises a SceneError,
        MapError, TableError, WeightsError, ConfigError or PlanningError for unusable input, a StorageError if the
        method's folder holds files that this command did not write.
        """
        folder = self.folder / self.folder_name(method)
        poses = self._select(method, folder)
        omitted = len(self.waypoints) - len(poses.ids)
        if omitted:
            self.messages.append(f"{method}: {omitted} of {len(self.waypoints)} waypoints omitted, see the selection")
        self._render(poses, folder)
        errors = folder / ERRORS
        if self.config.localize:
            self._localize(poses, folder)
        elif not errors.is_file():
            self.messages.append(f"{method}: not localized yet, {errors} is missing")
            return None
        return Scores.of(poses, read_errors(errors))

    def folder_name(self, method: str) -> str:
        """Return the name of a method's folder, which includes the limit on rotations."""
        limited = self.config.max_turn_deg is not None and method not in (ACTLOC, ACTLOC_FIXED)
        return f"{method}-turn{self.config.max_turn_deg:g}" if limited else method

    # -- selection

    def _select(self, method: str, folder: Path) -> PoseFile:
        path = folder / POSES
        cache = ArtifactCache(folder, self._selection_key(method), "select", CACHE, STEPS)
        if not cache.is_current(path):
            outputs = [folder / name for name in (POSES, ERRORS, ESTIMATES, IMAGES)]
            foreign = [output for output in outputs if output.exists()]
            if foreign and cache.stored_key is None:
                problem = "a file that this command did not write would be replaced"
                raise StorageError(problem, path=foreign[0], fix="Give another folder: --out FOLDER.")
            ids, poses = self._actloc_selection() if method == ACTLOC else self._selection(method)
            for output in outputs[:-1]:
                output.unlink(missing_ok=True)
            shutil.rmtree(folder / IMAGES, ignore_errors=True)
            cache.clear()
            write_poses(path, ids, poses)
            cache.store()
        return read_poses(path)

    def _selection_key(self, method: str) -> str:

        config = self.config
        parts: list[Any] = [VERSION, self._model_key, fingerprint(self.scene.mesh), fingerprint(self.scene.waypoints)]
        if method not in (ACTLOC, ACTLOC_FIXED):
            weights = resolve_weights("" if method == BEST else method, config.weights)
            parts += [[] if weights is None else [fingerprint(weights)]]
            parts += [config.directions, config.lattice, config.max_turn_deg]
        return cache_key("select", method, *parts)

    def _actloc_selection(self) -> tuple[Sequence[str], Float]:

        arrays = model_arrays(read_model(self.scene.model))
        self._check_frame(arrays.points)
        return self.waypoints.ids, actloc_views(arrays.points[arrays.errors_px < MAX_ERROR_PX], self.waypoints.points)

    def _selection(self, method: str) -> tuple[Sequence[str], Float]:

        config = self.config
        baseline = method == ACTLOC_FIXED
        look = WhereToLook.from_colmap(
            self.scene.model,
            weights=None if baseline else config.weights,
            method="" if method == BEST else method,
            camera=CAMERA,
            scale=1,  # the benchmark is in metres, z up
            up="z",
            mesh=self.scene.mesh,
            directions=config.directions,
            lattice="yaw-pitch" if baseline else config.lattice,
            max_reprojection_error_px=MAX_ERROR_PX if baseline else None,
            device=config.device,
        )
        self._check_frame(look.localization_map.landmarks.points)
        views = look.best(
            self.waypoints, max_turn_deg=None if baseline else config.max_turn_deg, skip=True, progress=True
        )
        return views.waypoint_id, views.cam_from_world

    def _check_frame(self, points: Float) -> None:
        """Raise a SceneError if most landmarks (N, 3) m are far from the mesh."""
        low, high = self._mesh.bounds
        some = points[:: max(1, len(points) // 2000)]
        max_distance_m = float(np.linalg.norm(high - low) + np.abs(some - low).max())
        offset_m = float(np.median(MeshRaycaster(self._mesh).distance_to_surface(some, max_distance_m)))
        if not offset_m <= 0.25:  # median distance of landmarks from the mesh above which their frames differ
            problem = f"mesh and map have different frames: half of the landmarks are {offset_m:.3g} m from the mesh"
            raise SceneError(problem, path=self.scene.mesh, fix="Give the mesh in the frame of the map: --mesh FILE.")

    # -- images and localization

    def _render(self, poses: PoseFile, folder: Path) -> None:
        """Render the missing images of a selection."""
        import cv2

        files = [_image_file(folder, name) for name in poses.ids]
        missing = [row for row, path in enumerate(files) if not path.is_file()]
        for rows in self._batches(missing, len(files), f"{folder.name}: render"):
            images = self._renderer.render(DRAWN_CAMERA, poses.cam_from_world[rows]).rgb
            for row, rgb in zip(rows, images, strict=True):
                write_bytes(files[row], cv2.imencode(IMAGE_ENDING, rgb[:, :, ::-1])[1].tobytes())

    def _localize(self, poses: PoseFile, folder: Path) -> None:
        """Localize the images without errors; errors written by the benchmark's own script are kept."""
        errors = folder / ERRORS
        estimates = folder / ESTIMATES
        key = cache_key("localize", self._map_key, LOCALIZER.record())
        cache = ArtifactCache(folder, key, "localize", CACHE, STEPS)
        if errors.is_file() and cache.stored_key is None:
            self.messages.append(f"{folder.name}: errors of another localizer are kept, {errors}")
            return
        error_of: dict[str, tuple[float, float]] = {}
        estimate_of: dict[str, Float] = {}
        if cache.is_current(errors):
            done = read_errors(errors)
            error_of = dict(zip(done.ids, zip(done.metres, done.degrees, strict=True), strict=True))
            if estimates.is_file():
                known = read_poses(estimates)
                estimate_of = dict(zip(known.ids, known.cam_from_world, strict=True))
        else:
            errors.unlink(missing_ok=True)
            estimates.unlink(missing_ok=True)
        missing = [row for row, name in enumerate(poses.ids) if name not in error_of]
        if missing:
            cache.store()
        for rows in self._batches(missing, len(poses.ids), f"{folder.name}: localize"):
            found = self._estimates([_image_file(folder, poses.ids[row]) for row in rows])
            for row, pose in zip(rows, found, strict=True):
                if pose is not None:
                    estimate_of[poses.ids[row]] = pose
                metres, degrees = pose_error(
                    np.full((3, 4), np.nan) if pose is None else pose, poses.cam_from_world[row]
                )
                error_of[poses.ids[row]] = (float(metres), float(degrees))
            if estimate_of:
                in_order = [name for name in poses.ids if name in estimate_of]
                write_poses(estimates, in_order, np.array([estimate_of[name] for name in in_order]))
            write_errors(errors, list(error_of), *np.array(list(error_of.values()), dtype=np.float64).T)

    def _estimates(self, files: list[Path]) -> list[Float | None]:
        """Return the estimated poses (3, 4) of images; like the benchmark, any pose counts."""
        images = []
        for path in files:
            image = read_rgb(path)
            if image is None:
                raise SceneError("a rendered image is unreadable", path=path, fix="Remove it and run again.")
            images.append(image)
        keypoints = self._localizer.extractor.extract_batch(images)
        matches = self._localizer.match(keypoints)
        estimate = self._localizer.estimate
        return [estimate(one, matched).cam_from_world for one, matched in zip(keypoints, matches, strict=True)]

    def _batches(self, rows: list[int], total: int, title: str) -> Iterator[list[int]]:
        """Yield batches of rows, with a progress bar of all."""
        with tqdm(total=total, initial=total - len(rows), desc=f"{self.scene.name}, {title}", disable=not rows) as bar:
            for start in range(0, len(rows), BATCH):
                yield rows[start : start + BATCH]
                bar.update(len(rows[start : start + BATCH]))

    # -- shared by all methods

    @cached_property
    def _localizer(self) -> Localizer:
        from wheretolook.mapping.colmap_model import LANDMARKS_FILE

        folder = self.folder / MAP_FOLDER
        device = self.config.device
        if not ArtifactCache(folder, self._map_key, "map", CACHE).is_current(folder / LANDMARKS_FILE):
            with atomic_folder(folder) as partial:
                build_query_map(self.scene, self._renderer, partial, self.config.workers, device)
                ArtifactCache(partial, self._map_key, "map", CACHE).store()
        return Localizer(Landmarks.load(folder / LANDMARKS_FILE), CAMERA, LOCALIZER, device=device)

    @cached_property
    def _mesh(self) -> TexturedMesh:

        return load_mesh(self.scene.mesh)

    @cached_property
    def _renderer(self) -> Renderer:

        return WarpRenderer(self._mesh, self.config.device)

    @cached_property
    def _model_key(self) -> str:

        paths = [self.scene.model / (name + suffix) for name in MODEL_FILES for suffix in (".bin", ".txt")]
        return cache_key("model", [(path.name, fingerprint(path)) for path in paths if path.is_file()])

    @cached_property
    def _map_key(self) -> str:

        return cache_key("map", self._model_key, fingerprint(self.scene.mesh), versions())


def _image_file(folder: Path, name: str) -> Path:
    return folder / IMAGES / f"{name}{IMAGE_ENDING}"


def _checked(waypoints: Waypoints) -> Waypoints:
    """Return waypoints whose ids are unique and can name files; raise a TableError otherwise."""
    for row, name in enumerate(waypoints.ids):
        invalid = not name or set(name) & set(' /\\:*?"<>|#') or name.startswith(".") or name.endswith(IMAGE_ENDING)
        if invalid or name in waypoints.ids[:row]:
            fix = "Use numbers or letters, each once, because ids name images."
            raise TableError("an id cannot name a file", path=waypoints.path, value=waypoints.where(row), fix=fix)
    return waypoints


_FIX = "Localize with the benchmark's own script instead: --localizer none."
_RENDER_BATCH = 16


def build_query_map(scene: BenchmarkScene, renderer: Renderer, folder: Path, workers: int, device: str) -> None:
    """Triangulate SIFT landmarks and save them with descriptors in an existing folder.

    The released maps have SuperPoint keypoints, whose descriptors need SuperPoint's network; here SIFT is extracted
    from the same images, and the poses are kept. Image pairs are chosen by the overlap of their surface in the mesh.

    Raises a MapError if the images are missing or of another size than the map's camera, the map has several cameras or
    a camera with distortion, or nothing can be triangulated.
    """
    config = MapConfig()
    model = read_model(scene.model)
    camera, *others = {*cameras_by_id(model.cameras, scene.model).values()}
    if others or not isinstance(camera, PinholeCamera):
        raise MapError("the benchmark's maps have one pinhole camera", path=scene.model, fix=_FIX)
    poses = colmap_poses(scene.model, model)
    names = [model.images[number].name for number in sorted(model.images) if model.images[number].has_pose]
    files = [scene.image_file(name) for name in names]
    depth: list[NDArray[np.float32]] = []
    for start in range(0, len(poses), _RENDER_BATCH):
        depth.extend(shrink_depth(renderer.render(DRAWN_CAMERA, poses[start : start + _RENDER_BATCH]).depth_m))
    pairs = choose_pairs(surface_overlap(DRAWN_CAMERA, poses, np.stack(depth)), PARTNERS)
    with WorkerPool(workers) as processes:
        run = MapRun(config, processes, device=device)
        images = (_read(path, camera) for path in files)
        stored, colors = zip(*extract_with_colors(images, len(files), "map: extract", run), strict=True)
        database = folder / DATABASE_FILE
        built = triangulate_model(database, posed_model(camera, poses), stored, colors, pairs, run)
        finish_map(MapDraft(built, scene.images, config.max_reprojection_error_px, _FIX, database), folder, run)


def _read(path: Path, camera: PinholeCamera) -> NDArray[np.uint8]:
    """Read an image (H, W, 3), RGB, of a camera."""
    image = read_rgb(path)
    if image is None or image.shape[:2] != (camera.height, camera.width):
        problem = f"not an image of {camera.width}x{camera.height} px, the size of the map's camera"
        raise MapError(problem, path=path, fix="Copy the original file.")
    return image


def read_rgb(path: Path) -> NDArray[np.uint8] | None:
    """Read an image (H, W, 3) uint8, RGB; None if it is missing or unreadable."""
    import cv2

    try:
        return np.asarray(read_image(path, cv2.IMREAD_COLOR)[:, :, ::-1], dtype=np.uint8)
    except (OSError, ValueError):
        return None


def run_scenes(
    scenes: Sequence[BenchmarkScene], methods: Sequence[str], out: Path, config: RoundConfig
) -> list[Result]:
    """Run the benchmark in scenes by every method, each scene in a folder of `out`, and print the messages."""
    for method in methods:
        if method not in (BEST, ACTLOC):
            check_method(method)
    rounds = [SceneRound(scene, out / scene.name, config) for scene in scenes]
    results: list[Result] = []
    while rounds:
        one = rounds.pop(0)  # so that its mesh goes when it is done
        scores_of = {one.folder_name(method): one.run(method) for method in methods}
        results += [Result(one.scene.name, name, scores) for name, scores in scores_of.items() if scores]
        for line in one.messages:
            print(f"{one.scene.name}: {line}")
    return results
