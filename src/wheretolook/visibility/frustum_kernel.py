"""Warp functions that decide whether a landmark is in view, and the kernel that collects those that are.

Both are exact, see `wheretolook.visibility.frustum`.
"""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp


@wp.func
def dot(a: wp.vec3, b: wp.vec3) -> wp.float64:
    """Products of float32 are exact in float64, so that fusing multiply and add changes nothing."""
    x = wp.float64(a[0]) * wp.float64(b[0])
    y = wp.float64(a[1]) * wp.float64(b[1])
    z = wp.float64(a[2]) * wp.float64(b[2])
    return x + y + z


@wp.func
def offset_from(location: wp.vec3d, point: wp.vec3d) -> wp.vec3:
    d = point - location
    return wp.vec3(wp.float32(d[0]), wp.float32(d[1]), wp.float32(d[2]))


@wp.func
def inside_sides(left: wp.vec3, right: wp.vec3, top: wp.vec3, bottom: wp.vec3, offset: wp.vec3) -> wp.bool:
    zero = wp.float64(0.0)
    return (
        dot(left, offset) >= zero
        and dot(right, offset) > zero
        and dot(top, offset) >= zero
        and dot(bottom, offset) > zero
    )


@wp.func
def in_view(sides: wp.array2d[wp.vec3], row: wp.int32, offset: wp.vec3, min_depth: wp.float64) -> wp.bool:
    if not wp.isfinite(offset):
        return False
    return dot(sides[row, 4], offset) > min_depth and inside_sides(
        sides[row, 0], sides[row, 1], sides[row, 2], sides[row, 3], offset
    )


@wp.func
def pixel_of(axes: wp.mat33, offset: wp.vec3, focal: wp.float64, cx: wp.float64, cy: wp.float64) -> wp.vec2d:
    """Pixel coordinates; `axes` are the camera's in the world, the rows of cam_from_world.

    Only in modules that do not fuse multiply and add: fused, it rounds once where NumPy rounds twice, which moves a
    landmark on the edge of a pixel or a bin to the next.
    """
    depth = dot(axes[2], offset)
    return wp.vec2d(focal * (dot(axes[0], offset) / depth) + cx, focal * (dot(axes[1], offset) / depth) + cy)


@wp.kernel
def collect_kernel(
    sides: wp.array2d[wp.vec3],
    centers: wp.array[wp.vec3d],
    location_rows: wp.array[wp.int32],
    points: wp.array[wp.vec3d],
    starts: wp.array[wp.int32],
    candidates: wp.array[wp.int32],
    min_depth: wp.float64,
    write: wp.bool,
    out_starts: wp.array[wp.int32],
    lengths: wp.array[wp.int32],
    indices: wp.array[wp.int32],
):
    view = wp.tid()
    location = location_rows[view]
    count = wp.int32(0)
    for entry in range(starts[location], starts[location + 1]):
        landmark = candidates[entry]
        if in_view(sides, view, offset_from(centers[view], points[landmark]), min_depth):
            if write:
                indices[out_starts[view] + count] = landmark
            count += 1
    lengths[view] = count
