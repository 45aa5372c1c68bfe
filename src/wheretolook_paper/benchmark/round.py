"""The benchmark's round on a scene: select views, draw them, localize the images, score. Each step resumes."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.geometry.lattices import Lattice
from wheretolook.geometry.poses import Float, pose_error
from wheretolook.localization.config import LocalizerConfig
from wheretolook.select.waypoints import Waypoints, read_waypoints
from wheretolook.utils.artifact_cache import cache_key
from wheretolook.utils.confine import entry_of
from wheretolook.utils.errors import SceneError, StorageError, TableError
from wheretolook.utils.files import atomic_folder, fingerprint, write_bytes, write_json
from wheretolook.utils.reading import read_json_object
from wheretolook.utils.version import VERSION
from wheretolook_paper.benchmark.actloc_baseline import MAX_ERROR_PX, MENDED, SHIPPED, shipped_views
from wheretolook_paper.benchmark.files import IMAGE_ENDING, PoseFile, read_errors, read_poses, write_errors, write_poses
from wheretolook_paper.benchmark.folder import CAMERA, DRAWN_CAMERA, BenchmarkScene
from wheretolook_paper.benchmark.scores import Scores

if TYPE_CHECKING:
    from wheretolook.geometry.mesh import TexturedMesh
    from wheretolook.localization.localizer import Localizer
    from wheretolook.rendering.warp_renderer import WarpRenderer

POSES = "selected_gt_poses.txt"
IMAGES = "images"
ERRORS = "pose_errors.txt"
ESTIMATES = "estimate_poses.txt"
"""Files in a method's folder, by the names that the benchmark's scripts give them."""

BEST = "best"  # stands for the method of the weights
MAP_FOLDER = "map"
KEYS = "made-from.json"
AT_ONCE = 16  # images that are drawn, or localized, between two steps of the progress bar
OFF_MESH_M = 0.25  # median distance of landmarks from the mesh at which the two have different frames
LOCALIZER = LocalizerConfig(max_error_px=12.0)  # of RANSAC, as in match_and_localize.py


@dataclass(frozen=True)
class RoundConfig:
    """How views are selected and localized."""

    weights: Path | None = None  # file or folder; None for the weights that ship
    directions: int = 500
    lattice: Lattice = "fibonacci"
    max_turn_deg: float | None = None  # greatest rotation from a view to the next, in the order of waypoints
    localize: bool = True  # False: errors are only read, from files of the benchmark's own script
    workers: int = 1
    device: str = "cpu"
    progress: bool = True


class SceneRound:
    """A scene's round, with files in a folder: one folder for each method, and `map/` for all.

    `told` collects what a user should know: waypoints left out, methods without errors yet.
    """

    def __init__(self, scene: BenchmarkScene, folder: Path, config: RoundConfig) -> None:
        self.scene = scene
        self.folder = folder
        self.config = config
        self.waypoints = _checked(read_waypoints(scene.waypoints))
        if config.localize and not (folder / MAP_FOLDER / KEYS).is_file():
            scene.check_images()
        self.told: list[str] = []

    def run(self, method: str) -> Scores | None:
        """Do what is missing of a method's round: a name of the registry, `BEST` or `SHIPPED`.

        None if the images are to be localized by the benchmark's own script, and its errors are not there yet. Raises a
        SceneError, MapError, TableError, WeightsError, ConfigError or PlanningError for input that cannot be used, a
        StorageError if files of others are in the method's folder.
        """
        folder = self.folder / self.folder_name(method)
        poses = self._selected(method, folder)
        left_out = len(self.waypoints) - len(poses)
        if left_out:
            self.told.append(f"{method}: {left_out} of {len(self.waypoints)} waypoints left out, see the selection")
        self._draw(poses, folder)
        errors = folder / ERRORS
        if self.config.localize:
            self._localize(poses, folder)
        elif not errors.is_file():
            self.told.append(f"{method}: not localized yet, {errors} is missing")
            return None
        return Scores.of(poses, read_errors(errors))

    def folder_name(self, method: str) -> str:
        """The name of a method's folder, which tells the limit on turns if there is one."""
        limited = self.config.max_turn_deg is not None and method not in (SHIPPED, MENDED)
        return f"{method}-turn{self.config.max_turn_deg:g}" if limited else method

    # -- selection

    def _selected(self, method: str, folder: Path) -> PoseFile:
        path = folder / POSES
        config = self.config
        baseline = method in (SHIPPED, MENDED)
        parts: list[Any] = [VERSION, self._model_key, self._mesh_key, fingerprint(self.scene.waypoints), method]
        if not baseline:
            weights = self._weights(method)
            parts += [_files_key(weights), config.directions, config.lattice, config.max_turn_deg]
        key = cache_key("select", parts)
        if _key(folder, "select") == key and path.is_file():
            return read_poses(path)
        _refuse_foreign(folder)
        ids, poses = self._shipped() if method == SHIPPED else self._best(method)
        _forget(folder)
        write_poses(path, ids, poses)
        _note(folder, "select", key)
        return read_poses(path)

    def _shipped(self) -> tuple[Sequence[str], Float]:
        from wheretolook.mapping.colmap_model import model_arrays, read_model

        arrays = model_arrays(read_model(self.scene.model))
        self._check_frame(arrays.points)
        return self.waypoints.ids, shipped_views(arrays.points[arrays.errors_px < MAX_ERROR_PX], self.waypoints.points)

    def _best(self, method: str) -> tuple[Sequence[str], Float]:
        from wheretolook.select.where_to_look import WhereToLook

        config = self.config
        baseline = method == MENDED
        look = WhereToLook.from_colmap(
            self.scene.model,
            weights=None if baseline else config.weights,
            method="" if method == BEST else method,
            camera=CAMERA,
            mesh=self.scene.mesh,
            directions=config.directions,
            lattice="yaw-pitch" if baseline else config.lattice,
            max_reprojection_error_px=MAX_ERROR_PX if baseline else None,
            device=config.device,
        )
        self._check_frame(look.localization_map.landmarks.points)
        max_turn_deg = None if baseline else config.max_turn_deg
        views = look.best(self.waypoints, max_turn_deg=max_turn_deg, skip=True, progress=config.progress)
        return views.waypoint_id, views.cam_from_world

    def _weights(self, method: str) -> Path | None:
        from wheretolook.weights.resolve import resolve_weights

        return resolve_weights("" if method == BEST else method, self.config.weights)

    def _check_frame(self, points: Float) -> None:
        """Raise a SceneError if landmarks (N, 3) do not lie on the mesh."""
        from wheretolook.rendering.raycasting import MeshRaycaster

        low, high = self._mesh.bounds
        some = points[:: max(1, len(points) // 2000)]
        farthest_m = float(np.linalg.norm(high - low) + np.abs(some - low).max())
        off_m = float(np.median(MeshRaycaster(self._mesh).distance_to_surface(some, farthest_m)))
        if not off_m <= OFF_MESH_M:
            fix = "Give the mesh in the frame of the map, in metres, z up: --mesh FILE."
            problem = (
                "mesh and map do not lie on one another: half of the landmarks are farther from the mesh than this"
            )
            raise SceneError(problem, path=self.scene.mesh, value=f"{off_m:.3g} m", fix=fix)

    # -- images

    def _draw(self, poses: PoseFile, folder: Path) -> None:
        files = [entry_of(folder / IMAGES, f"{name}{IMAGE_ENDING}", "a view's id") for name in poses.ids]
        missing = np.flatnonzero([not path.is_file() for path in files])
        if len(missing) == 0:
            return
        (folder / IMAGES).mkdir(parents=True, exist_ok=True)
        cam_from_world = poses.cam_from_world
        for rows in self._blocks(missing, len(files), f"{self.scene.name}, {folder.name}: draw"):
            for row, rgb in zip(rows, self._renderer.render(DRAWN_CAMERA, cam_from_world[rows]).rgb, strict=True):
                _write_image(files[row], rgb)

    # -- localization

    def _localize(self, poses: PoseFile, folder: Path) -> None:
        """Localize the images whose errors are not there; those of the benchmark's own script are left alone."""
        from wheretolook_paper.benchmark.query_map import read_image

        errors = folder / ERRORS
        estimates = folder / ESTIMATES
        key = cache_key("localize", [self._map_key, LOCALIZER.record()])
        noted = _key(folder, "localize")
        done = {}
        if errors.is_file() and noted is None:
            self.told.append(f"{folder.name}: errors of another localizer are kept, {errors}")
            return
        if errors.is_file() and noted == key:
            there = read_errors(errors)
            done = dict(zip(there.ids, zip(there.metres, there.degrees, strict=True), strict=True))
        else:
            errors.unlink(missing_ok=True)
            estimates.unlink(missing_ok=True)
        missing = np.flatnonzero([name not in done for name in poses.ids])
        if len(missing) == 0:
            return
        localizer = self._localizer
        _note(folder, "localize", key)
        found: dict[str, Float] = {}
        if done and estimates.is_file():
            there_too = read_poses(estimates)
            found = dict(zip(there_too.ids, there_too.cam_from_world, strict=True))
        cam_from_world = poses.cam_from_world
        nothing = np.full((3, 4), np.nan)
        for rows in self._blocks(missing, len(poses), f"{self.scene.name}, {folder.name}: localize"):
            images = []
            for row in rows:
                path = folder / IMAGES / f"{poses.ids[row]}{IMAGE_ENDING}"
                image = read_image(path)
                if image is None:
                    raise SceneError("a drawn image cannot be read", path=path, fix="Remove it and run again.")
                images.append(image)
            keypoints = localizer.extract(images)
            for row, seen, matches in zip(rows, keypoints, localizer.match(keypoints), strict=True):
                estimate = localizer.estimate(seen, *matches).cam_from_world  # any pose counts, as in the benchmark
                if estimate is not None:
                    found[poses.ids[row]] = estimate
                metres, degrees = pose_error(nothing if estimate is None else estimate, cam_from_world[row])
                done[poses.ids[row]] = (metres, degrees)
            in_order = [name for name in poses.ids if name in found]
            if in_order:
                write_poses(estimates, in_order, np.array([found[name] for name in in_order]))
            write_errors(errors, list(done), *np.array(list(done.values()), dtype=np.float64).T)

    @cached_property
    def _localizer(self) -> Localizer:
        from wheretolook.localization.localizer import Localizer
        from wheretolook.mapping.landmarks import Landmarks
        from wheretolook.mapping.rendered_map import LANDMARKS_FILE
        from wheretolook_paper.benchmark.query_map import build_query_map

        folder = self.folder / MAP_FOLDER
        config = self.config
        if _key(folder, "map") != self._map_key or not (folder / LANDMARKS_FILE).is_file():
            with atomic_folder(folder) as partial:
                build_query_map(self.scene, self._renderer, partial, config.workers, config.device, config.progress)
                _note(partial, "map", self._map_key)
        return Localizer(Landmarks.load(folder / LANDMARKS_FILE), CAMERA, LOCALIZER, device=config.device)

    # -- what all methods share

    @cached_property
    def _mesh(self) -> TexturedMesh:
        from wheretolook.scenes.loading import load_mesh

        return load_mesh(self.scene.mesh)

    @cached_property
    def _renderer(self) -> WarpRenderer:
        from wheretolook.rendering.warp_renderer import WarpRenderer

        return WarpRenderer(self._mesh, self.config.device)

    @cached_property
    def _model_key(self) -> str:
        from wheretolook.mapping.colmap_model import MODEL_FILES

        paths = [self.scene.model / (name + suffix) for name in MODEL_FILES for suffix in (".bin", ".txt")]
        return cache_key("model", [(path.name, fingerprint(path)) for path in paths if path.is_file()])

    @cached_property
    def _mesh_key(self) -> str:
        return fingerprint(self.scene.mesh)

    @cached_property
    def _map_key(self) -> str:
        from wheretolook.localization.labeller import versions

        return cache_key("map", [self._model_key, self._mesh_key, versions()])

    def _blocks(self, rows: NDArray[np.int64], total: int, title: str) -> Iterator[NDArray[np.int64]]:
        """Rows that are worked on together, with a progress bar of all."""
        bar = tqdm(total=total, initial=total - len(rows), desc=title, unit="image", disable=not self.config.progress)
        with bar:
            for start in range(0, len(rows), AT_ONCE):
                yield rows[start : start + AT_ONCE]
                bar.update(len(rows[start : start + AT_ONCE]))


def _checked(waypoints: Waypoints) -> Waypoints:
    """Waypoints whose ids can name files, each once; a TableError if not."""
    for row, name in enumerate(waypoints.ids):
        if not name or set(name) & set(' /\\:*?"<>|#') or name.startswith(".") or name.endswith(IMAGE_ENDING):
            fix = "Ids name images: use numbers or letters."
            raise TableError("this id cannot name a file", path=waypoints.path, value=waypoints.where(row), fix=fix)
        if name in waypoints.ids[:row]:
            raise TableError("an id stands there twice", path=waypoints.path, value=name, fix="Each needs its own.")
    return waypoints


def _files_key(path: Path | None) -> list[str]:
    """Fingerprints of a file, or of the weights in a folder."""
    if path is None:
        return []
    return [fingerprint(file) for file in ([path] if path.is_file() else sorted(path.glob("*.safetensors")))]


def _write_image(path: Path, rgb: NDArray[np.uint8]) -> None:
    import cv2

    write_bytes(path, cv2.imencode(IMAGE_ENDING, rgb[:, :, ::-1])[1].tobytes())


def _keys(folder: Path) -> dict[str, str]:
    try:
        return read_json_object(folder / KEYS)
    except (OSError, ValueError):
        return {}


def _key(folder: Path, step: str) -> str | None:
    """What a step's results in a folder were made from; None if there are none of ours."""
    return _keys(folder).get(step)


def _note(folder: Path, step: str, key: str) -> None:
    write_json(folder / KEYS, _keys(folder) | {step: key})


def _refuse_foreign(folder: Path) -> None:
    """Raise a StorageError if files in a method's folder were not made here."""
    foreign = [name for name in (POSES, ERRORS, ESTIMATES, IMAGES) if (folder / name).exists()]
    if foreign and not (folder / KEYS).is_file():
        problem = "files that were not made here would be replaced"
        raise StorageError(problem, path=folder / foreign[0], fix="Name another folder: --out FOLDER.")


def _forget(folder: Path) -> None:
    """Remove what was made from views that are selected anew."""
    for name in (KEYS, POSES, ERRORS, ESTIMATES):
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(folder / IMAGES, ignore_errors=True)
