"""Build the viewpoint map of a simulated campus of a thousand rooms: 2.5 million landmarks, 125,000 voxels.

    python tests/benchmarks/bench_campus.py --device cuda --limit 150
    python tests/benchmarks/bench_campus.py --rooms 10
    python tests/benchmarks/bench_campus.py --voxels 500 --processes 2

Rooms as in bench_scale.py, with 125 voxels of a metre each. Walls are of triangles with edges of half a metre, and hide
the landmarks of other rooms; nothing else excludes these. A fiftieth of the voxels comes first; of the rest as many as fit
into --limit seconds follow, and the time of all is extrapolated. With --processes, through Ray, each task maps a building
of 40 rooms by its landmarks alone: those of other buildings are behind walls. Prints seconds, locations per second, and
the peak memory of the host and of the device.
"""

import resource
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import warp as wp
from bench_scale import IN_ROOM, PITCH_M, ROOMS_IN_ROW, building, room_offset
from common import ROOM_M, options

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import VoxelGrid, fibonacci_sphere
from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.map import Map
from wheretolook.planning.scene_map import build_viewpoint_map
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.scorers.weights import load_scorer
from wheretolook.visibility.occlusion import MeshOcclusion

IN_ROOM_VOXELS = 125
IN_BUILDING = 40  # rooms
EDGE_M = 0.5


def square(n_u, n_v):
    """Return vertices (V, 2) of a unit square cut into n_u x n_v rectangles, and two triangles (T, 3) for each."""
    v, u = np.meshgrid(np.linspace(0, 1, n_v + 1), np.linspace(0, 1, n_u + 1))
    corner = (np.arange(n_u)[:, None] * (n_v + 1) + np.arange(n_v)).reshape(-1)
    a, b, c, d = corner, corner + n_v + 1, corner + n_v + 2, corner + 1
    return np.column_stack([u.ravel(), v.ravel()]), np.concatenate(
        [np.column_stack([a, b, c]), np.column_stack([a, c, d])]
    )


def walls(rooms):
    """Return the mesh of the walls, floors and ceilings of rooms, given by their numbers."""
    low, high = np.array(ROOM_M)
    size = high - low
    vertices, triangles = [], []
    for axis in range(3):
        along = [other for other in range(3) if other != axis]
        flat, corners = square(*np.ceil(size[along] / EDGE_M).astype(int))
        for side in (low, high):
            at = np.empty((len(flat), 3))
            at[:, along] = low[along] + flat * size[along]
            at[:, axis] = side[axis]
            triangles.append(corners + sum(map(len, vertices)))
            vertices.append(at)
    room, faces = np.concatenate(vertices), np.concatenate(triangles)
    every = (faces + len(room) * np.arange(len(rooms))[:, None, None]).reshape(-1, 3).astype(np.int32)
    n = len(every)
    return TexturedMesh(
        (room + room_offset(rooms)[:, None]).reshape(-1, 3).astype(np.float32), every,
        np.zeros((n, 3, 2), np.float32), np.zeros(n, np.int32), (np.zeros((1, 1, 3), np.uint8),),
    )  # fmt: skip


def voxels_of(n_rooms):
    """Return a grid over all rooms, and the ids (n_rooms, `IN_ROOM_VOXELS`) of voxels of each."""
    low, high = np.array(ROOM_M)
    offsets = room_offset(np.arange(n_rooms))
    bounds = np.array([low, high + offsets.max(0)])
    shape = tuple(np.round((bounds[1] - bounds[0]) / (1.0, 1.0, 0.87)).astype(int).tolist())
    grid = VoxelGrid.over(bounds, shape)
    inside = np.stack(np.meshgrid(*(np.arange(0.5, n) for n in (10, 8, 3)), indexing="ij"), -1).reshape(-1, 3)
    chosen = np.argsort(np.random.default_rng(0).random((n_rooms, len(inside))), axis=1)[:, :IN_ROOM_VOXELS]
    points = low + (inside * (1.0, 1.0, 2.6 / 3))[chosen] + offsets[:, None]
    return grid, grid.location_ids(points)


def campus(rooms, device):
    """Return the default scorer of rooms, given by their numbers."""
    landmarks, room = building(len(rooms) * IN_ROOM)
    moved = room_offset(rooms[room]) - room_offset(room)
    landmarks = replace(landmarks, points=landmarks.points + moved)
    occlusion = MeshOcclusion(MeshRaycaster(walls(rooms), device))
    return load_scorer(LocalizationMap(Map(landmarks), PinholeCamera(), occlusion, device))


def memory():
    """Return the peak memory so far, as text."""
    host = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    if not torch.cuda.is_available():
        return f"host {host:.1f} GB"
    device = wp.get_mempool_used_mem_high("cuda") + torch.cuda.max_memory_allocated()
    return f"host {host:.1f} GB, device {device / 1e9:.1f} GB"


def build(grid, scorer, ids, clock=time.perf_counter):
    """Build the viewpoint map of some voxels; return it and the seconds it takes."""
    start = clock()
    made = build_viewpoint_map(scorer, grid, ids, fibonacci_sphere(500))
    return made, clock() - start


def map_building(rooms, grid, ids):
    """Map voxels of rooms by their landmarks; return the CPU seconds to open and to score, and the peak memory."""
    start = time.process_time()
    scorer = campus(rooms, "cpu")
    scorer.score_directions(grid.centers()[ids[:1]], fibonacci_sphere(500))
    opened_s = time.process_time() - start
    return opened_s, build(grid, scorer, ids, time.process_time)[1], memory()


def main():
    args = options(__doc__, device="cpu", rooms=1_000, voxels=0, processes=0, limit=1e9)
    start = time.perf_counter()
    grid, ids = voxels_of(args.rooms)
    chosen = ids[:, :: max(1, ids.size // args.voxels)] if args.voxels else ids
    print(f"{args.rooms * IN_ROOM:,} landmarks, {chosen.size:,} of {ids.size:,} voxels, rooms {PITCH_M:.0f} m apart, "
          f"{ROOMS_IN_ROW} in a row, on {args.device}", flush=True)  # fmt: skip

    def show(name, n, seconds):
        whole = seconds * ids.size / n
        print(f"{name}: {n:,} voxels in {seconds:.1f} s, {n / seconds:,.1f} a second; all of them {whole:,.0f} s; "
              f"peak of {memory()}", flush=True)  # fmt: skip

    if args.processes:
        import ray  # not needed on a machine with a GPU

        ray.init(num_cpus=args.processes, include_dashboard=False, log_to_driver=False)
        buildings = np.split(np.arange(args.rooms), range(IN_BUILDING, args.rooms, IN_BUILDING))
        remote = ray.remote(num_cpus=1)(map_building)
        tasks = [remote.remote(rooms, grid, chosen[rooms].ravel()) for rooms in buildings]
        opened_s, scored_s, used = zip(*ray.get(tasks), strict=True)
        wall_s = time.perf_counter() - start
        whole = (sum(opened_s) + sum(scored_s) * ids.size / chosen.size) / args.processes
        print(f"through Ray: {wall_s:.1f} s; {len(buildings)} buildings on {args.processes} processes, CPU seconds "
              f"{sum(opened_s):.1f} to open, {sum(scored_s):.1f} to score, {chosen.size / sum(scored_s):.1f} voxels a second "
              f"and core; all {ids.size:,} in {whole:,.0f} s; peak of {max(used)} a process")  # fmt: skip
        return
    scorer = campus(np.arange(args.rooms), args.device)
    print(f"campus: {time.perf_counter() - start:.1f} s, peak of {memory()}", flush=True)
    scorer.score_directions(grid.centers()[ids[0, :1]], fibonacci_sphere(500))
    first = chosen.ravel()[:: 50 if chosen.size >= 5_000 else 1]
    made, seconds = build(grid, scorer, first)
    show("first", len(first), seconds)
    if len(first) < chosen.size:
        share = args.limit / (seconds * chosen.size / len(first))
        made, seconds = build(grid, scorer, chosen.ravel()[: int(min(1, share) * chosen.size)])
        show("viewpoint map", len(made.scores), seconds)
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        made.save(Path(folder) / "map")
        size = sum(file.stat().st_size for file in (Path(folder) / "map").iterdir())
        print(f"saved in {time.perf_counter() - start:.1f} s, {size / 1e6:,.1f} MB")


if __name__ == "__main__":
    main()
