"""A COLMAP map of a scene from images rendered along a walk, with the poses known."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.features.extraction import KeypointExtractor
from wheretolook.features.keypoints import Keypoints
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.mapping.cameras import CAMERAS_FILE, colmap_poses, save_mapping_poses
from wheretolook.mapping.config import MapConfig
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks
from wheretolook.mapping.pairs import choose_pairs, shrink_depth, surface_overlap
from wheretolook.mapping.triangulation import image_name, triangulate_known_poses
from wheretolook.mapping.walk import FreeSpaceQueries, plan_walk
from wheretolook.utils.errors import MapError
from wheretolook.utils.processes import Processes

if TYPE_CHECKING:
    from wheretolook.rendering.raycasting import MeshRaycaster
    from wheretolook.rendering.types import Renderer

_RENDER_BATCH = 4
LANDMARKS_FILE, REPORT_FILE, DATABASE_FILE, IMAGES_FOLDER = "landmarks.npz", "report.json", "database.db", "images"


@dataclass(frozen=True)
class MapReport:
    """What came out of building a map; `report.json`.

    Attributes:
        n_images: images rendered.
        n_registered: images that see a landmark.
        n_keypoints: keypoints of all images.
        n_pairs: pairs of images matched.
        n_landmarks: landmarks after the filter.
        n_landmarks_removed: points the filter removed.
        median_track_length: observations of a landmark.
        mean_reprojection_error_px: mean over the landmarks.
        median_distance_to_mesh_cm: median distance from a landmark to the mesh.
        p90_distance_to_mesh_cm: 90th percentile of the same.
        walk_length_m: length of the walk.
        coverage: share of the reachable floor that the walk visits.
        visit_radius_m: walking distance from the walk within which floor counts as visited.
        seed: seed of the walk and of COLMAP.
        config: the configuration, as a dictionary.
        seconds: wall-clock time of each step.
    """

    n_images: int
    n_registered: int
    n_keypoints: int
    n_pairs: int
    n_landmarks: int
    n_landmarks_removed: int
    median_track_length: float
    mean_reprojection_error_px: float
    median_distance_to_mesh_cm: float
    p90_distance_to_mesh_cm: float
    walk_length_m: float
    coverage: float
    visit_radius_m: float
    seed: int
    config: dict[str, Any]
    seconds: dict[str, float]


def build_map(
    mesh: TexturedMesh,
    renderer: Renderer,
    free_space: FreeSpaceQueries,
    camera: PinholeCamera,
    config: MapConfig | None = None,
    seed: int = 0,
    out_dir: str | Path = "map",
    raycaster: MeshRaycaster | None = None,
    workers: int = 2,
    device: str = "cpu",
    progress: bool = True,
) -> MapReport:
    """Map a scene: walk, render, extract, match, triangulate with known poses, filter.

    The result is a COLMAP model (binary) that any COLMAP tool opens, with `landmarks.npz`, `cameras.npz`
    and `report.json` beside it.
    The model holds the filtered points only, so that every reader sees the same map. The folder appears when all is
    done; an interrupted or failed build leaves nothing and does not touch an earlier map.

    Args:
        mesh: the scene, metres, z up.
        renderer: renders `mesh`.
        free_space: free space of `mesh`.
        camera: intrinsics of the mapping camera.
        config: see `MapConfig`.
        seed: the same seed gives the same model and landmarks byte for byte.
        out_dir: folder to make; an earlier map there is replaced.
        raycaster: measures the distance from landmarks to the mesh; made on the CPU if None.
        workers: processes that extract keypoints and match them. Above 1 the caller's script must be guarded
            by `if __name__ == "__main__":`, as for any of Python's process pools.
        device: where keypoints are extracted, "cpu" or a CUDA device.
        progress: show progress bars.

    Returns:
        The content of `report.json`.

    Raises:
        MapError: the images give no landmark, or `out_dir` holds something that is not a map.
        SceneError: there is no floor to walk on.
    """
    config, out_dir, clock = config or MapConfig(), Path(out_dir), Clock()
    refuse_foreign_folder(out_dir)
    with partial_folder(out_dir) as partial, Processes(workers) as processes:
        with clock("walk"):
            walk = plan_walk(free_space, mesh.bounds, config.n_images, config.walk, seed)
            poses = poses_looking_along(walk.positions, walk.directions)
        with clock("render_and_extract"):
            keypoints, colors, depth_m = _render_and_extract(
                renderer, camera, poses, config, partial, processes, progress, device
            )
        with clock("pairs"):
            pairs = choose_pairs(surface_overlap(camera, poses, depth_m), config.partners)
        database = partial / DATABASE_FILE
        model = triangulate_known_poses(
            database,
            camera,
            poses,
            keypoints,
            colors,
            pairs,
            clock,
            max_epipolar_error_px=config.max_epipolar_error_px,
            min_triangulation_angle_deg=config.min_triangulation_angle_deg,
            two_view_landmarks=config.two_view_landmarks,
            seed=seed,
            processes=processes,
            progress=progress,
        )
        with clock("filter_and_write"):
            n_removed = remove_inaccurate(
                model, config.max_reprojection_error_px, out_dir,
                fix="Map with more images (n_images), or check that the scene has texture.",
            )  # fmt: skip
            model.write_binary(str(partial))
        with clock("landmarks"):
            landmarks = load_colmap_landmarks(partial, database, config.max_reprojection_error_px)
            landmarks.save(partial / LANDMARKS_FILE)
            save_mapping_poses(colmap_poses(partial), partial / CAMERAS_FILE)
        with clock("accuracy"):
            distance_cm = _surface_distance_cm(landmarks, mesh, raycaster)
        if not config.keep_database:
            database.unlink()
        report = MapReport(
            n_images=len(poses),
            n_registered=sum(image.num_points3D > 0 for image in model.images.values()),
            n_keypoints=sum(len(k) for k in keypoints),
            n_pairs=len(pairs),
            n_landmarks=len(landmarks),
            n_landmarks_removed=n_removed,
            median_track_length=float(np.median(landmarks.track_length)),
            mean_reprojection_error_px=float(landmarks.reprojection_error_px.mean()),
            median_distance_to_mesh_cm=float(np.median(distance_cm)),
            p90_distance_to_mesh_cm=float(np.quantile(distance_cm, 0.9)),
            walk_length_m=walk.length_m,
            coverage=walk.coverage,
            visit_radius_m=walk.visit_radius_m,
            seed=seed,
            config=asdict(config),
            seconds={**clock.seconds, "total": sum(clock.seconds.values())},
        )
        (partial / REPORT_FILE).write_text(json.dumps(asdict(report), indent=2) + "\n")
    return report


def refuse_foreign_folder(out_dir: Path) -> None:
    """Raise MapError if a folder, or a file in its place, holds anything but a map built here."""
    if out_dir.exists() and not (out_dir / REPORT_FILE).is_file() and (not out_dir.is_dir() or any(out_dir.iterdir())):
        raise MapError(
            "will not be replaced: it is not a map built here", path=out_dir, fix="Give another folder, or remove it."
        )


def remove_inaccurate(model: Any, max_reprojection_error_px: float, out_dir: Path, fix: str) -> int:
    """Remove a reconstruction's points with a larger mean reprojection error. Returns how many.

    Raises:
        MapError: none is left.
    """
    errors = {i: point.error for i, point in model.points3D.items()}
    removed = [i for i, error in errors.items() if not error <= max_reprojection_error_px]
    if len(removed) == len(errors):
        value = f"{len(errors)} triangulated, {len(removed)} removed"
        raise MapError("the images give no landmark", path=out_dir, value=value, fix=fix)
    for i in removed:
        model.delete_point3D(i)
    return len(removed)


class Clock:
    """Wall-clock time of each step, `seconds`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, step: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[step] = round(time.perf_counter() - start, 3)


@contextmanager
def partial_folder(out_dir: Path) -> Iterator[Path]:
    """An empty folder beside `out_dir` that takes its place if the block succeeds and is removed if it does not."""
    partial, old = (out_dir.with_name(f".{out_dir.name}.{suffix}") for suffix in ("partial", "replaced"))
    for leftover in (partial, old):
        shutil.rmtree(leftover, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        yield partial
        if out_dir.exists():
            os.replace(out_dir, old)
        os.replace(partial, out_dir)
        shutil.rmtree(old, ignore_errors=True)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def _render_and_extract(
    renderer: Renderer,
    camera: PinholeCamera,
    poses: NDArray[np.floating[Any]],
    config: MapConfig,
    partial: Path,
    processes: Processes,
    progress: bool,
    device: str,
) -> tuple[list[Keypoints], list[NDArray[np.uint8]], NDArray[np.float32]]:
    """Keypoints and their colours, image by image, and shrunk depth (I, h, w). Rendering overlaps with extraction."""
    depth: list[NDArray[np.float32]] = []
    waiting: list[NDArray[np.uint8]] = []

    def images() -> Iterator[NDArray[np.uint8]]:
        for start in range(0, len(poses), _RENDER_BATCH):
            rendering = renderer.render(camera, poses[start : start + _RENDER_BATCH])
            depth.extend(shrink_depth(rendering.depth_m))
            for offset, rgb in enumerate(rendering.rgb):
                if config.keep_images:
                    _write_png(partial / IMAGES_FOLDER / image_name(start + offset), rgb)
                waiting.append(rgb)
                yield rgb

    extracted = KeypointExtractor(config.extractor, device).extract_many(images(), processes)
    keypoints, colors = [], []
    with closing(extracted):
        for found in tqdm(extracted, "map: render, extract", total=len(poses), disable=not progress, unit="image"):
            column, row = found.pixels.astype(np.int64).T
            rgb = waiting.pop(0)
            colors.append(rgb[np.clip(row, 0, camera.height - 1), np.clip(column, 0, camera.width - 1)])
            keypoints.append(found)
    return keypoints, colors, np.stack(depth)


def _write_png(path: Path, rgb: NDArray[np.uint8]) -> None:
    import cv2

    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))


def _surface_distance_cm(
    landmarks: Landmarks, mesh: TexturedMesh, raycaster: MeshRaycaster | None
) -> NDArray[np.float64]:
    if raycaster is None:
        from wheretolook.rendering.raycasting import MeshRaycaster

        raycaster = MeshRaycaster(mesh)
    farthest_m = float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))
    return 100.0 * raycaster.distance_to_surface(landmarks.points, farthest_m).astype(np.float64)
