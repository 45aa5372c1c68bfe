"""Warp kernels of `MeshRaycaster`: one thread per ray, point or segment."""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def unoccluded_kernel(
    mesh: wp.uint64, origins: wp.array[wp.vec3], points: wp.array[wp.vec3], margin_m: float, clear: wp.array2d[bool]
):
    i, j = wp.tid()
    ray = points[j] - origins[i]
    distance = wp.length(ray)
    reach = distance - margin_m
    blocked = wp.bool(False)
    if reach > 0.0:
        blocked = wp.mesh_query_ray_anyhit(mesh, origins[i], ray / distance, reach)
    clear[i, j] = not blocked


@wp.kernel
def cast_kernel(
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    distance_m: wp.array[wp.float32],
    triangle: wp.array[wp.int32],
    front: wp.array[wp.bool],
):
    i = wp.tid()
    hit = wp.mesh_query_ray(mesh, origins[i], wp.normalize(directions[i]), 1.0e6)
    if hit.result:
        distance_m[i] = hit.t
        triangle[i] = hit.face
        front[i] = hit.sign > 0.0
    else:
        distance_m[i] = wp.inf
        triangle[i] = -1
        front[i] = False


@wp.kernel
def distance_kernel(mesh: wp.uint64, points: wp.array[wp.vec3], farthest_m: float, distance_m: wp.array[float]):
    i = wp.tid()
    nearest = wp.mesh_query_point_no_sign(mesh, points[i], farthest_m)
    distance_m[i] = wp.inf
    if nearest.result:
        at = wp.mesh_eval_position(mesh, nearest.face, nearest.u, nearest.v)
        distance_m[i] = wp.length(at - points[i])


@wp.kernel
def clear_kernel(
    mesh: wp.uint64, starts: wp.array[wp.vec3], ends: wp.array[wp.vec3], clearance_m: float, clear: wp.array[bool]
):
    # A ball as large as the distance to the nearest surface is empty, so step by that distance less the clearance.
    i = wp.tid()
    start = starts[i]
    length = wp.length(ends[i] - start)
    toward = (ends[i] - start) / wp.max(length, 1.0e-9)
    reach = length + 2.0 * clearance_m  # surfaces beyond this distance do not matter
    travelled = wp.float32(0.0)
    result = wp.bool(True)
    while result and travelled <= length:
        nearest = wp.mesh_query_point_no_sign(mesh, start + travelled * toward, reach)
        if not nearest.result:
            break
        at = wp.mesh_eval_position(mesh, nearest.face, nearest.u, nearest.v)
        distance = wp.length(at - start - travelled * toward)
        if distance < clearance_m:
            result = False
        if travelled == length:
            break
        travelled = wp.min(travelled + wp.max(distance - clearance_m, 0.1 * clearance_m), length)
    clear[i] = result
