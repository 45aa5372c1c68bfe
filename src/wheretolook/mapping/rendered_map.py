"""Map a mesh: render images along a walk through it and triangulate them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.mapping.config import PARTNERS, WALK, MapConfig
from wheretolook.mapping.map_folder import DATABASE_FILE, MapDraft, MapReport, finish_map, replacing_map
from wheretolook.mapping.triangulation import (
    choose_pairs,
    estimate_poses,
    extract_with_colors,
    image_name,
    posed_model,
    shrink_depth,
    surface_overlap,
    triangulate_model,
)
from wheretolook.rendering.appearance import Appearance
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.rendering.warp_renderer import Renderer
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.utils.files import write_bytes


class FreeSpaceQueries(Protocol):
    """The part of `wheretolook.space.free_space.FreeSpace` that a walk uses."""

    def is_free(self, points: Any) -> NDArray[np.bool_]: ...

    def segments_are_free(self, a: Any, b: Any) -> NDArray[np.bool_]: ...

    def floor_below(self, points: Any) -> NDArray[np.floating[Any]]: ...


@dataclass(frozen=True)
class PartOfFloor:
    """Free space above a part of the floor: rectangles (x0, y0, x1, y1) in metres; a step may lead between two."""

    space: FreeSpaceQueries
    rectangles: tuple[tuple[float, float, float, float], ...]

    def is_free(self, points: Any) -> NDArray[np.bool_]:
        """Whether a camera can be at points (N, 3)."""
        xy = np.asarray(points)[:, None, :2]
        rectangles = np.asarray(self.rectangles)
        inside = ((xy >= rectangles[:, :2]) & (xy <= rectangles[:, 2:])).all(-1).any(-1)
        return np.asarray(inside & self.space.is_free(points))

    def segments_are_free(self, a: Any, b: Any) -> NDArray[np.bool_]:
        """Whether a camera can move straight from a (N, 3) to b (N, 3), both above this part; (N,)."""
        return self.is_free(a) & self.is_free(b) & self.space.segments_are_free(a, b)

    def floor_below(self, points: Any) -> NDArray[np.floating[Any]]:
        """Height (N,) of the floor below points (N, 3)."""
        return self.space.floor_below(points)


@dataclass(frozen=True, eq=False)
class Walk:
    """A walk and the camera poses along it."""

    positions: Float  # (n, 3) metres, camera centres in the order of the walk
    directions: Float  # (n, 3) unit optical axes in the world
    path: Float  # (M, 3) metres, corners of the walk at mean eye height; every segment between two corners is free
    coverage: float  # share of the reachable floor within `visit_radius_m` walking distance of the walk
    visit_radius_m: float  # the radius used

    @property
    def length_m(self) -> float:
        """Length of the path in metres."""
        return _length_m(self.path)


def plan_walk(
    free_space: FreeSpaceQueries,
    bounds: ArrayLike,
    n_images: int,
    seed: int = 0,
    coverage: float = WALK.coverage,
    unevenness: float = 0.0,
) -> Walk:
    """Plan a walk that starts at a random place and goes to the nearest unvisited floor until enough is visited.

    `bounds` (2, 3) metres are the lowest and highest corner of the scene; `coverage` is the share of the reachable
    floor to visit. The poses look mostly along the walk. Their spacings along it are equal, or follow a gamma
    distribution whose standard deviation is `unevenness` times its mean: above 1, the camera often turns on the spot.
    Raises ConfigError for fewer than two images, SceneError if there is no floor to walk on.
    """
    if n_images < 2:
        raise ConfigError("a map needs at least two images", value=n_images)
    rng = np.random.default_rng(seed)
    eyes, steps = _reachable_places(free_space, np.asarray(bounds, dtype=np.float64))
    start = int(rng.integers(len(eyes)))
    radius_m = WALK.visit_radius_m
    while True:
        corners, visited = _visit(steps, start, radius_m, coverage)
        path = eyes[corners]
        if len(corners) == 1 or _length_m(path) <= (n_images - 1) * WALK.image_spacing_m:
            break
        radius_m *= 1.2
    positions, headings = _along(path, n_images, rng, unevenness)
    varied = positions.copy()
    varied[:, 2] += WALK.eye_height_variation_m * rng.uniform(-1, 1, n_images)
    free = free_space.segments_are_free(positions, varied)
    positions = np.where(free[:, None], varied, positions)
    return Walk(positions, _swing(headings, rng), path, visited, radius_m)


def _length_m(path: Float) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def _reachable_places(free_space: FreeSpaceQueries, bounds: Float) -> tuple[Float, csr_matrix]:
    """Find the largest connected set of eye positions (P, 3) above free floor, over all storeys of the scene.

    Also returns the symmetric graph (P, P) of free steps between neighbouring cells, weighted by length.
    """
    low, high = bounds
    n_cells = np.maximum(np.ceil((high - low)[:2] / WALK.cell_m).astype(int), 1)
    heights = np.arange(low[2] + WALK.eye_height_m, high[2] + WALK.eye_height_m, 1.0)  # below a storey's height
    *cell, level = np.indices((*n_cells, len(heights))).reshape(3, -1)
    cells = np.column_stack(cell)
    probes = np.column_stack([low[:2] + (cells + 0.5) * WALK.cell_m, heights[level]])
    probes[:, 2] = free_space.floor_below(probes)
    has_floor = np.isfinite(probes[:, 2])
    eyes = probes[has_floor]
    # Several probes of a cell may hit the same floor: one place for each floor of each cell.
    key = np.column_stack([cells[has_floor], np.rint(100 * eyes[:, 2])])
    key, first = np.unique(key, axis=0, return_index=True)
    eyes = eyes[first] + (0, 0, WALK.eye_height_m)
    free = (eyes[:, 2] < high[2]) & free_space.is_free(eyes)  # a roof is not a floor to walk on
    if not free.any():
        fix = "Check that the scene is in metres with z up, or lower the clearance of free space."
        raise SceneError("there is no free floor to walk on at eye height", value=f"{WALK.eye_height_m} m", fix=fix)
    eyes = eyes[free]
    cells = key[free, :2]
    a, b = cKDTree(cells).query_pairs(1, p=np.inf, output_type="ndarray").T
    # There must be floor at about the same height at both places and half way: no step off a gallery or over a gap.
    middle = (eyes[a] + eyes[b]) / 2
    below = middle[:, 2] - WALK.eye_height_m - free_space.floor_below(middle)
    drop = np.column_stack([eyes[a, 2] - eyes[b, 2], below])
    near = (np.abs(drop) <= WALK.max_step_height_m).all(1)  # False where there is no floor (NaN)
    near &= (cells[a] != cells[b]).any(1)
    near[near] = free_space.segments_are_free(eyes[a[near]], eyes[b[near]])
    a = a[near]
    b = b[near]
    steps = csr_matrix((np.linalg.norm(eyes[a] - eyes[b], axis=1), (a, b)), shape=(len(eyes), len(eyes)))
    steps = steps + steps.T
    component = connected_components(steps, directed=False)[1]
    members = np.flatnonzero(component == np.bincount(component).argmax())
    if len(members) < 2:
        problem = "no two neighbouring places of the floor are joined by a free step"
        raise SceneError(problem, value=f"cell {WALK.cell_m} m", fix="Lower the clearance of free space.")
    return eyes[members], steps[members][:, members]


def _visit(steps: csr_matrix, start: int, radius_m: float, coverage: float) -> tuple[NDArray[np.int64], float]:
    """Walk through a graph of places until a share is within a radius; indices of places, and the share visited."""
    here = start
    corners = [here]
    new = [here]
    visited = np.zeros(steps.shape[0], dtype=bool)
    while True:
        reached = dijkstra(steps, indices=new, min_only=True, limit=radius_m)
        visited |= np.isfinite(reached)
        if visited.mean() >= coverage:
            return np.array(corners), float(visited.mean())
        distance, previous = dijkstra(steps, indices=here, return_predecessors=True)
        target = int(np.where(visited, np.inf, distance).argmin())
        new = [target]
        while (last := int(previous[new[-1]])) != here and last >= 0:
            new.append(last)
        new.reverse()
        corners += new
        here = target


def _along(path: Float, n_images: int, rng: np.random.Generator, unevenness: float) -> tuple[Float, Float]:
    """Space points (n, 3) along a path; also returns the horizontal unit direction of the path at each (n, 2)."""
    start = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.linspace(0, start[-1], n_images)
    if unevenness:
        ends = np.cumsum(rng.gamma(unevenness**-2, size=n_images - 1))
        at[1:] = start[-1] * ends / ends[-1]

    def point(s: Float) -> Float:
        return np.stack([np.interp(s, start, path[:, k]) for k in range(3)], axis=1)

    ahead_m = 1.0  # of the point that the camera looks at, along the walk
    behind = np.maximum(np.minimum(at, start[-1] - ahead_m), 0)
    heading = (point(behind + ahead_m) - point(behind))[:, :2]
    length = np.linalg.norm(heading, axis=1)
    angle = rng.uniform(0, 2 * np.pi)
    last = np.array([np.cos(angle), np.sin(angle)])
    for k in range(n_images):
        if length[k] > 0.1:  # where the walk turns back on itself, the last direction is kept
            last = heading[k] / length[k]
        heading[k] = last
    return point(at), heading


def _swing(headings: Float, rng: np.random.Generator) -> Float:
    """Optical axes (n, 3) of a hand-held camera that swings about horizontal directions (n, 2)."""
    n = len(headings)
    phase = 2 * np.pi * (np.arange(n) / WALK.swing_period + rng.uniform())
    yaw = np.arctan2(headings[:, 1], headings[:, 0])
    yaw = yaw + np.radians(WALK.swing_deg * np.sin(phase) + rng.normal(0, 5, n))
    pitch = np.radians(WALK.pitch_deg + WALK.pitch_variation_deg * rng.uniform(-1, 1, n))
    return np.column_stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])


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
) -> RenderedMapReport:
    """Map a scene in metres, z up: walk, render, extract, match, triangulate with known poses, filter.

    The result is a binary COLMAP model of the filtered points, with `landmarks.npz`, `cameras.npz` and `report.json`,
    which is also returned. It replaces an earlier map when all is done, after `before_replace`; a failed build changes
    nothing. The same seed gives the same bytes. Several workers need `if __name__ == "__main__":` in the caller's script.
    Raises MapError if the images give no landmark or `out_dir` holds something else, SceneError without floor to walk
    on.
    """
    config = config or MapConfig()
    with replacing_map(config, out_dir, seed, workers, device, progress, before_replace) as (folder, run):
        clock = run.clock
        with clock("walk"):
            walk = _walk(free_space, mesh, config, seed)
            poses = poses_looking_along(walk.positions, walk.directions)
        with clock("render_and_extract"):
            depth: list[NDArray[np.float32]] = []
            drawn = Appearance.of_views(poses, config.appearance, seed) if config.appearance else []
            keep_in = folder / "images" if config.keep_images else None
            images = _rendered(renderer, camera, poses, drawn, depth, keep_in)
            extracted = extract_with_colors(images, len(poses), "map: render, extract", run)
            stored, colors = zip(*extracted, strict=True)
        with clock("pairs"):
            pairs = choose_pairs(surface_overlap(camera, poses, np.stack(depth)), PARTNERS)
            if config.vary == "drift":
                furthest = np.exp(np.random.default_rng([seed, 3]).uniform(np.log(3), np.log(len(poses))))
                pairs = pairs[pairs[:, 1] - pairs[:, 0] <= furthest]
        database = folder / DATABASE_FILE
        model = triangulate_model(database, posed_model(camera, poses), stored, colors, pairs, run)
        if config.vary == "drift":
            with clock("adjust"):
                estimate_poses(model)
        fix = "Map with more images (n_images), or check that the scene has texture."
        draft = MapDraft(model, Path(out_dir), config.max_reprojection_error_px, fix, database)
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
    limit_m = float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0]))
    return 100.0 * (raycaster or MeshRaycaster(mesh)).distance_to_surface(points, limit_m).astype(np.float64)


def _walk(free_space: FreeSpaceQueries, mesh: TexturedMesh, config: MapConfig, seed: int) -> Walk:
    """Plan the walk of a map; with `config.vary`, draw coverage, unevenness and a share of the images."""
    if not config.vary:
        return plan_walk(free_space, mesh.bounds, config.n_images, seed)
    rng = np.random.default_rng([seed, 2])  # [seed, 1] draws the mapping camera
    share = np.exp(rng.uniform(np.log(0.08), np.log(1.0)))
    coverage = rng.uniform(0.15, 0.8)
    unevenness = rng.uniform(0.0, 2.0)
    n_images = min(max(8, round(share * config.n_images)), config.n_images)
    return plan_walk(free_space, mesh.bounds, n_images, seed, coverage, unevenness)


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
    batch = 4
    for start in range(0, len(poses), batch):
        rendering = renderer.render(camera, poses[start : start + batch])
        for index, (rgb, depth_m) in enumerate(zip(rendering.rgb, rendering.depth_m, strict=True), start):
            depth.append(shrink_depth(depth_m))
            if drawn:
                rgb = drawn[index].apply(rgb, camera, depth_m)
            if keep_in is not None:
                path = keep_in / image_name(index)
                write_bytes(path, cv2.imencode(path.suffix, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes())
            yield rgb
