"""Build the map that rendered images are localized against: SIFT triangulated from the map's images at its poses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import PinholeCamera, cameras_by_id
from wheretolook.mapping.colmap_model import colmap_poses, read_model
from wheretolook.mapping.config import PARTNERS, MapConfig
from wheretolook.mapping.map_folder import DATABASE_FILE, MapDraft, MapRun, finish_map
from wheretolook.mapping.triangulation import (
    choose_pairs,
    extract_with_colors,
    posed_model,
    shrink_depth,
    surface_overlap,
    triangulate_model,
)
from wheretolook.utils.errors import MapError
from wheretolook.utils.files import read_image
from wheretolook.utils.processes import WorkerPool
from wheretolook_paper.benchmark.folder import DRAWN_CAMERA, BenchmarkScene

if TYPE_CHECKING:
    from wheretolook.rendering.warp_renderer import Renderer

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
