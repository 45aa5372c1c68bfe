"""Make a COLMAP map of a scene from images rendered at known poses along a walk."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import Float, camera_centers, poses_looking_along
from wheretolook.mapping.config import COVERAGES, MIN_VARIED_IMAGES, PARTNERS, SHARES_OF_IMAGES, UNEVENNESS, MapConfig
from wheretolook.mapping.map_folder import DATABASE_FILE, IMAGES_FOLDER, MapDraft, MapReport, finish_map, replacing_map
from wheretolook.mapping.triangulation import (
    choose_pairs,
    extract_with_colors,
    image_name,
    posed_model,
    shrink_depth,
    surface_overlap,
    triangulate_model,
)
from wheretolook.mapping.walk import FreeSpaceQueries, Walk, plan_walk
from wheretolook.rendering.appearance import Appearance
from wheretolook.utils.files import write_bytes

if TYPE_CHECKING:
    from wheretolook.rendering.raycasting import MeshRaycaster
    from wheretolook.rendering.types import Renderer

_RENDER_BATCH = 4
_FIX = "Map with more images (n_images), or check that the scene has texture."


@dataclass(frozen=True)
class RenderedMapReport(MapReport):
    """Properties of a map from rendered images; `report.json`."""

    n_registered: int  # images that observe a landmark
    n_keypoints: int  # keypoints of all images
    n_pairs: int  # pairs of images matched
    median_distance_to_mesh_cm: float  # median distance from a landmark to the mesh
    p90_distance_to_mesh_cm: float  # 90th percentile of the same
    walk_length_m: float  # length of the walk
    coverage: float  # share of the reachable floor that the walk visits
    visit_radius_m: float  # walking distance from the walk within which floor counts as visited


def build_map(  # a scene has four parts, and the output and its resources are the caller's choice
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
    before_replace: Callable[[], None] = lambda: None,
    poses: NDArray[np.floating[Any]] | None = None,
) -> RenderedMapReport:
    """Map a scene in metres, z up: walk, render, extract, match, triangulate with known poses, filter.

    With `poses` (M, 3, 4), images are rendered there instead of along a walk. The result is a binary COLMAP model of
    the filtered points, with `landmarks.npz`, `cameras.npz` and `report.json`, which is also returned. It replaces an
    earlier map when all is done, after `before_replace`; a failed build changes nothing. The same seed gives the same
    bytes. Several workers need `if __name__ == "__main__":` in the caller's script. Raises MapError if the images give
    no landmark or `out_dir` holds something else, SceneError without floor to walk on.
    """
    config = config or MapConfig()
    with replacing_map(config, out_dir, seed, workers, device, progress, before_replace) as (folder, run):
        clock = run.clock
        with clock("walk"):
            if poses is None:
                walk = _walk(free_space, mesh, config, seed)
                poses = poses_looking_along(walk.positions, walk.directions)
            else:
                centers = np.asarray(camera_centers(poses), dtype=np.float64)
                walk = Walk(centers, np.asarray(poses[:, 2, :3]), centers, 1.0, 0.0)
        with clock("render_and_extract"):
            depth: list[NDArray[np.float32]] = []
            drawn = Appearance.of_views(poses, config.appearance, seed) if config.appearance else []
            keep_in = folder / IMAGES_FOLDER if config.keep_images else None
            images = _rendered(renderer, camera, poses, drawn, depth, keep_in)
            extracted = extract_with_colors(images, len(poses), "map: render, extract", run)
            stored, colors = zip(*extracted, strict=True)
        with clock("pairs"):
            pairs = choose_pairs(surface_overlap(camera, poses, np.stack(depth)), PARTNERS)
        database = folder / DATABASE_FILE
        model = triangulate_model(database, posed_model(camera, poses), stored, colors, pairs, run)
        draft = MapDraft(model, Path(out_dir), config.max_reprojection_error_px, _FIX, database)
        landmarks, fields = finish_map(draft, folder, run)
        with clock("accuracy"):
            distance_cm = _distance_cm(landmarks.points, mesh, raycaster)
        report = RenderedMapReport(
            n_images=len(poses),
            **fields,
            seconds=clock.with_total(),
            n_registered=sum(image.num_points3D > 0 for image in model.images.values()),
            n_keypoints=sum(len(pixels) for pixels, _ in stored),
            n_pairs=len(pairs),
            median_distance_to_mesh_cm=float(np.median(distance_cm)),
            p90_distance_to_mesh_cm=float(np.quantile(distance_cm, 0.9)),
            walk_length_m=walk.length_m,
            coverage=walk.coverage,
            visit_radius_m=walk.visit_radius_m,
        )
        report.save(folder)
    return report


def _distance_cm(points: Float, mesh: TexturedMesh, raycaster: MeshRaycaster | None) -> Float:
    """Distances (N,) in centimetres from points (N, 3) to a mesh."""
    from wheretolook.rendering.raycasting import MeshRaycaster

    limit_m = float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))
    return 100.0 * (raycaster or MeshRaycaster(mesh)).distance_to_surface(points, limit_m).astype(np.float64)


def _walk(free_space: FreeSpaceQueries, mesh: TexturedMesh, config: MapConfig, seed: int) -> Walk:
    """Plan the walk of a map; with `config.vary`, one of those in `mapping.config`."""
    if not config.vary:
        return plan_walk(free_space, mesh.bounds, config.n_images, seed)
    rng = np.random.default_rng([seed, 2])  # [seed, 1] draws the mapping camera
    log_share, coverage, unevenness = (rng.uniform(*x) for x in (np.log(SHARES_OF_IMAGES), COVERAGES, UNEVENNESS))
    n_images = max(MIN_VARIED_IMAGES, round(np.exp(log_share) * config.n_images))
    return plan_walk(free_space, mesh.bounds, min(n_images, config.n_images), seed, coverage, unevenness)


def _rendered(
    renderer: Renderer,
    camera: PinholeCamera,
    poses: Float,
    drawn: Sequence[Appearance],
    depth: list[NDArray[np.float32]],
    keep_in: Path | None,
) -> Iterator[NDArray[np.uint8]]:
    """Render images (H, W, 3) at poses (I, 3, 4), with their appearances if these are drawn.

    Images are written to a folder if one is given, and depth is added to `depth`.
    """
    import cv2

    for start in range(0, len(poses), _RENDER_BATCH):
        rendering = renderer.render(camera, poses[start : start + _RENDER_BATCH])
        for index, (rgb, depth_m) in enumerate(zip(rendering.rgb, rendering.depth_m, strict=True), start):
            depth.append(shrink_depth(depth_m))
            if drawn:
                rgb = drawn[index].apply(rgb, camera, depth_m)
            if keep_in is not None:
                path = keep_in / image_name(index)
                write_bytes(path, cv2.imencode(path.suffix, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes())
            yield rgb
