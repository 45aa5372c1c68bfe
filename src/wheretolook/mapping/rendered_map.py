"""A COLMAP map of a scene from images rendered along a walk, with the poses known."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
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
from wheretolook.geometry.poses import Float, camera_centers, poses_looking_along
from wheretolook.mapping import triangulation
from wheretolook.mapping.colmap_model import CAMERAS_FILE, colmap_poses, save_mapping_poses, write_model
from wheretolook.mapping.config import PARTNERS, MapConfig
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks
from wheretolook.mapping.triangulation import image_name, triangulate_known_poses
from wheretolook.mapping.walk import FreeSpaceQueries, Walk, plan_walk
from wheretolook.utils.errors import MapError
from wheretolook.utils.files import atomic_folder, write_bytes, write_json
from wheretolook.utils.processes import WorkerPool

if TYPE_CHECKING:
    from wheretolook.rendering.raycasting import MeshRaycaster
    from wheretolook.rendering.types import Renderer

_RENDER_BATCH = 4
LANDMARKS_FILE = "landmarks.npz"
REPORT_FILE = "report.json"
DATABASE_FILE = "database.db"
IMAGES_FOLDER = "images"


@dataclass(frozen=True)
class MapReport:
    """What came out of building a map; `report.json`."""

    n_images: int  # images rendered
    n_registered: int  # images that see a landmark
    n_keypoints: int  # keypoints of all images
    n_pairs: int  # pairs of images matched
    n_landmarks: int  # landmarks after the filter
    n_landmarks_removed: int  # points the filter removed
    median_track_length: float  # observations of a landmark
    mean_reprojection_error_px: float  # mean over the landmarks
    median_distance_to_mesh_cm: float  # median distance from a landmark to the mesh
    p90_distance_to_mesh_cm: float  # 90th percentile of the same
    walk_length_m: float  # length of the walk
    coverage: float  # share of the reachable floor that the walk visits
    visit_radius_m: float  # walking distance from the walk within which floor counts as visited
    seed: int  # seed of the walk and of COLMAP
    config: dict[str, Any]  # the configuration, as a dictionary
    seconds: dict[str, float]  # wall-clock time of each step


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
    replacing: Callable[[], None] = lambda: None,
    poses: NDArray[np.floating[Any]] | None = None,
) -> MapReport:
    """Map a scene in metres, z up: walk, render, extract, match, triangulate with known poses, filter.

    With `poses` (M, 3, 4), images are taken there instead of along a walk.

    The result is a COLMAP model (binary) that any COLMAP tool opens, with `landmarks.npz`, `cameras.npz` and
    `report.json`, which is also returned, beside it. The model holds the filtered points only, so that every reader
    gets the same map. The folder appears when all is done; an interrupted or failed build leaves nothing behind and
    does not touch an earlier map, which a finished one replaces. The same seed gives the same bytes.

    `raycaster` measures the distance from landmarks to the mesh. Keypoints are extracted on `device`, "cpu" or a CUDA
    device, and matched, by `workers` processes; above 1 the caller's script must be guarded by
    `if __name__ == "__main__":`, as for any of Python's process pools. `replacing` is called when all is done, right
    before the folder changes. Raises MapError if the images give no landmark
    or `out_dir` holds something that is not a map, SceneError if there is no floor to walk on.
    """
    config = config or MapConfig()
    out_dir = Path(out_dir)
    clock = Clock()
    refuse_foreign_folder(out_dir)
    with atomic_folder(out_dir, replacing) as partial, WorkerPool(workers) as processes:
        with clock("walk"):
            if poses is None:
                walk = plan_walk(free_space, mesh.bounds, config.n_images, config.walk, seed)
                poses = poses_looking_along(walk.positions, walk.directions)
            else:
                at, ahead = (np.asarray(of, dtype=np.float64) for of in (camera_centers(poses), poses[:, 2, :3]))
                walk = Walk(at, ahead, at, 1.0, 0.0)
        with clock("render_and_extract"):
            depth: list[NDArray[np.float32]] = []
            images = _rendered(renderer, camera, poses, depth, partial / IMAGES_FOLDER if config.keep_images else None)
            extractor = KeypointExtractor(config.extractor, device)
            extracted = extract_with_colors(extractor, images, len(poses), processes, "map: render, extract", progress)
            keypoints, colors = zip(*extracted, strict=True)
        with clock("pairs"):
            overlap = triangulation.surface_overlap(camera, poses, np.stack(depth))
            pairs = triangulation.choose_pairs(overlap, PARTNERS)
        database = partial / DATABASE_FILE
        views = camera, poses, keypoints, colors
        model = triangulate_known_poses(database, *views, pairs, config, clock, seed, processes, progress)
        with clock("filter_and_write"):
            fix = "Map with more images (n_images), or check that the scene has texture."
            n_removed = remove_inaccurate(model, config.max_reprojection_error_px, out_dir, fix)
            write_model(model, partial)
        with clock("landmarks"):
            landmarks = save_landmarks(partial, database, config.max_reprojection_error_px)
        with clock("accuracy"):
            from wheretolook.rendering.raycasting import MeshRaycaster

            farthest_m = float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))
            caster = raycaster or MeshRaycaster(mesh)
            distance_cm = 100.0 * caster.distance_to_surface(landmarks.points, farthest_m).astype(np.float64)
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
        write_json(partial / REPORT_FILE, asdict(report))
    return report


def refuse_foreign_folder(out_dir: Path) -> None:
    """Raise MapError if a folder, or a file in its place, holds anything but a map built here."""
    if out_dir.exists() and not (out_dir / REPORT_FILE).is_file() and (not out_dir.is_dir() or any(out_dir.iterdir())):
        problem = "will not be replaced: it is not a map built here"
        fix = "Give another folder, or remove it."
        raise MapError(problem, path=out_dir, fix=fix)


def save_landmarks(folder: Path, database: Path, max_reprojection_error_px: float) -> Landmarks:
    """Write the landmarks and the mapping images' poses of the COLMAP model in a folder beside it."""
    landmarks = load_colmap_landmarks(folder, database, max_reprojection_error_px)
    landmarks.save(folder / LANDMARKS_FILE)
    save_mapping_poses(colmap_poses(folder), folder / CAMERAS_FILE)
    return landmarks


def remove_inaccurate(model: Any, max_reprojection_error_px: float, out_dir: Path, fix: str) -> int:
    """Remove points of a reconstruction with a larger mean reprojection error; how many. MapError if none is left."""
    errors = {i: point.error for i, point in model.points3D.items()}
    removed = [i for i, error in errors.items() if not error <= max_reprojection_error_px]
    if len(removed) == len(errors):
        value = f"{len(errors)} triangulated, {len(removed)} removed"
        raise MapError("the images give no landmark", path=out_dir, value=value, fix=fix)
    for i in removed:
        model.delete_point3D(i)
    return len(removed)


class Clock:
    """Times the steps of a map: `with clock("step"):`. Wall-clock times by step are in `seconds`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, step: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[step] = round(time.perf_counter() - start, 3)


def extract_with_colors(
    extractor: KeypointExtractor,
    images: Iterable[NDArray[np.uint8]],
    n_images: int,
    processes: WorkerPool,
    title: str,
    progress: bool,
    same_size: bool = True,
) -> Iterator[tuple[Keypoints, NDArray[np.uint8]]]:
    """Keypoints of images (H, W, 3) uint8, in their order, and the colours (N, 3) uint8 at them.

    The images are made while others are worked on. A GPU works on batches if all are of the same size.
    """
    waiting: deque[NDArray[np.uint8]] = deque()

    def remembered() -> Iterator[NDArray[np.uint8]]:
        for rgb in images:
            waiting.append(rgb)
            yield rgb

    if extractor.on_gpu and not same_size:
        extracted: Generator[Keypoints, None, None] = (extractor.extract(rgb) for rgb in remembered())
    else:
        extracted = extractor.extract_many(remembered(), processes)
    with closing(extracted):
        for keypoints in tqdm(extracted, title, total=n_images, disable=not progress, unit="image"):
            rgb = waiting.popleft()
            column, row = keypoints.pixels.astype(np.int64).T
            yield keypoints, rgb[np.clip(row, 0, rgb.shape[0] - 1), np.clip(column, 0, rgb.shape[1] - 1)]


def _rendered(
    renderer: Renderer, camera: PinholeCamera, poses: Float, depth: list[NDArray[np.float32]], keep_in: Path | None
) -> Iterator[NDArray[np.uint8]]:
    """Images (H, W, 3) of poses (I, 3, 4), written to a folder if one is given. Adds their shrunk depth to `depth`."""
    import cv2

    for start in range(0, len(poses), _RENDER_BATCH):
        rendering = renderer.render(camera, poses[start : start + _RENDER_BATCH])
        depth.extend(triangulation.shrink_depth(rendering.depth_m))
        for offset, rgb in enumerate(rendering.rgb):
            if keep_in is not None:
                path = keep_in / image_name(start + offset)
                write_bytes(path, cv2.imencode(path.suffix, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes())
            yield rgb
