"""Measure viewpoint maps: single and batch queries, building, and the choice of views along a path.

    python tests/benchmarks/bench_viewpoint_map.py [--device cuda] [--weights data/release/weights/set.safetensors]

A generated apartment with landmarks on its surfaces and mesh occlusion, 512 free voxels and 500 directions. The scorer
is `bins` unless weights are given. Queries are at random points in free voxels. Prints the median and the range over
repeats.
"""

import tempfile
from dataclasses import replace
from itertools import cycle
from pathlib import Path

import numpy as np
from common import options, points_on_surface, room_map, timed

from wheretolook.geometry.lattices import VoxelGrid, fibonacci_sphere
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.map import Map
from wheretolook.planning.scene_map import build_viewpoint_map
from wheretolook.planning.stops import refine_directions
from wheretolook.planning.view_sequence import TurnLimit, best_sequence
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.scenes.config import ApartmentConfig
from wheretolook.scorers.registry import make_scorer
from wheretolook.scorers.weights import load_scorer
from wheretolook.space.free_space import FreeSpace
from wheretolook.utils.processes import cores
from wheretolook.visibility.occlusion import MeshOcclusion
from wheretolook_rooms.generator import generate_apartment


def queries(viewpoint_map, n, repeats):
    """Time queries of single points and of a batch of n points."""
    rng = np.random.default_rng(0)
    grid = viewpoint_map.grid
    rows = rng.integers(0, len(viewpoint_map.scores), n)
    points = viewpoint_map.locations[rows] + rng.uniform(-0.5, 0.5, (len(rows), 3)) * grid.voxel_m
    arrays = list(points[:5000])
    tuples = points[:5000].tolist()
    axis = np.array([0.6, -0.8, 0.0])

    def each(query, points=arrays):
        def work():
            for point in points:
                query(point)

        return work

    n = len(arrays)
    for name, query in {
        "best": viewpoint_map.best,
        "best 10": lambda point: viewpoint_map.best_n(point, 10),
        "best in a cone of 30 degrees": lambda point: viewpoint_map.best_in_cone(point, axis, 30),
        "best within a turn of 30 degrees": lambda point: viewpoint_map.best_reachable(point, axis, 30),
        "all directions, interpolated": viewpoint_map.interpolated,
    }.items():
        timed(name, each(query), repeats, n)
    timed("best, point a tuple", each(viewpoint_map.best, tuples), repeats, n)
    median = timed(f"best, a batch of {len(points):,}", lambda: viewpoint_map.best_many(points), repeats)
    print(f"{'':62} {len(points) / median / 1e6:.1f} million points a second")


def sequences(repeats, n, d):
    """Time the choice of views along a path of n waypoints among d directions."""
    scores = np.random.default_rng(0).random((n, d))
    directions = fibonacci_sphere(d)
    limit = TurnLimit.of(directions)
    timed(f"turn limit of {d} directions", lambda: TurnLimit.of(directions), repeats)
    timed(f"best sequence, {n} waypoints", lambda: best_sequence(scores, limit), repeats)


def main():
    """Parse the options, measure and print a table."""
    args = options(
        __doc__, device="cpu", weights=Path, landmarks=25_000, voxels=512, directions=500, repeats=7, builds=3,
        queries=1_000_000, waypoints=200,
    )  # fmt: skip
    mesh = generate_apartment(ApartmentConfig(), 0, device=args.device)
    grid = VoxelGrid.over(mesh.bounds, (24, 24, 8))
    free_space = FreeSpace(mesh, device=args.device)
    free = np.flatnonzero(free_space.is_free(grid.centers()))[: args.voxels]
    points = points_on_surface(mesh, args.landmarks, np.random.default_rng(0))
    room = room_map(args.landmarks, grid.centers()[:1], args.device)  # its random attributes are used
    landmarks = replace(room.landmarks, points=points)
    occlusion = MeshOcclusion(MeshRaycaster(mesh, args.device), two_sided=free_space.two_sided)
    directions = fibonacci_sphere(args.directions)

    mapped = LocalizationMap(Map(landmarks), room.camera, occlusion, args.device)
    scorer = load_scorer(mapped, args.weights) if args.weights else make_scorer("bins", mapped)
    print(f"{len(free)} voxels x {len(directions)} directions, {len(landmarks):,} landmarks, "
          f"{len(mesh.triangles):,} triangles, {scorer.name}, on {args.device}, "
          f"{cores()} cores")  # fmt: skip
    timed("build", lambda: build_viewpoint_map(scorer, grid, free, directions), args.builds)
    viewpoint_map = build_viewpoint_map(scorer, grid, free, directions)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map"
        timed("save", lambda: viewpoint_map.save(path), args.repeats)
        size = sum(file.stat().st_size for file in path.iterdir())
        timed(f"load, {size / 1e6:.1f} MB", lambda: ViewpointMap.load(path), args.repeats)
        timed("load, memory-mapped", lambda: ViewpointMap.load(path, mmap=True), args.repeats)
        queries(ViewpointMap.load(path, mmap=True), args.queries, args.repeats)
    sequences(args.repeats, args.waypoints, args.directions)
    best = directions[viewpoint_map.ranked[:, 0]]
    rows = cycle(range(len(best)))

    def refine_one():
        row = next(rows)
        refine_directions(scorer, viewpoint_map.locations[row], best[row])

    timed("refine the best direction of one location", refine_one, 7 * args.repeats)
    some = slice(0, 64)
    found = refine_directions(scorer, viewpoint_map.locations[some], best[some])
    gain = found.score - viewpoint_map.scores[some].max(axis=1)
    print(f"{'':62} {np.mean(gain > 0):.0%} of 64 gain, by {gain.mean():.4f} in score on average")


if __name__ == "__main__":
    main()
