"""Warp functions that decide whether a landmark is in view, and the kernel that collects those that are.

Both are exact, see `wheretolook.visibility.frustum`.
"""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(1.0e15)  # beyond this many metres single precision may overflow


@wp.struct
class ViewBatch:
    """B views of a pinhole camera, and the landmarks that are unoccluded from their locations."""

    sides: wp.array2d[wp.vec3]  # (B, 5), see `frustum_sides`
    centers: wp.array[wp.vec3d]  # (B,) camera centres
    location_rows: wp.array[wp.int32]  # (B,) which of the L locations each view is at
    points: wp.array[wp.vec3d]  # (N,) landmarks
    starts: wp.array[wp.int32]  # (L + 1,) first entry of each location in `unoccluded`
    unoccluded: wp.array[wp.int32]  # rows of `points`
    min_depth: wp.float64  # metres
    rounding: wp.float32  # see `sides_rounding`


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
def entry_offset(views: ViewBatch, view: wp.int32, entry: wp.int32) -> wp.vec3:
    """Offset from a view's camera centre to the landmark of an entry of `unoccluded`."""
    return offset_from(views.centers[view], views.points[views.unoccluded[entry]])


@wp.func
def inside_sides(left: wp.vec3, right: wp.vec3, top: wp.vec3, bottom: wp.vec3, offset: wp.vec3) -> wp.bool:
    zero = wp.float64(0.0)
    inside_x = dot(left, offset) >= zero and dot(right, offset) > zero
    return inside_x and dot(top, offset) >= zero and dot(bottom, offset) > zero


@wp.func
def in_view(sides: wp.array2d[wp.vec3], row: wp.int32, offset: wp.vec3, min_depth: wp.float64) -> wp.bool:
    if not wp.isfinite(offset):
        return False
    inside = inside_sides(sides[row, 0], sides[row, 1], sides[row, 2], sides[row, 3], offset)
    return inside and dot(sides[row, 4], offset) > min_depth


@wp.func
def least_product(left: wp.vec3, right: wp.vec3, top: wp.vec3, bottom: wp.vec3, offset: wp.vec3) -> wp.float32:
    """Least product of an offset with the normals of the four sides, in single precision."""
    across = wp.min(wp.dot(left, offset), wp.dot(right, offset))
    return wp.min(across, wp.min(wp.dot(top, offset), wp.dot(bottom, offset)))


@wp.func
def rounding_error(offset: wp.vec3, rounding: wp.float32) -> wp.float32:
    """Bound on the rounding error of `least_product`."""
    return rounding * (wp.abs(offset[0]) + wp.abs(offset[1]) + wp.abs(offset[2]))


@wp.func
def surely_in_sides(
    left: wp.vec3, right: wp.vec3, top: wp.vec3, bottom: wp.vec3, offset: wp.vec3, rounding: wp.float32
) -> wp.bool:
    """As `inside_sides`; single precision decides unless the landmark is within its rounding error of a side."""
    least = least_product(left, right, top, bottom, offset)
    error = rounding_error(offset, rounding)
    inside = least > error
    if not inside and least >= -error:
        inside = inside_sides(left, right, top, bottom, offset)
    return inside


@wp.func
def pixel_of(axes: wp.mat33, offset: wp.vec3, focal: wp.vec2d, center: wp.vec2d) -> wp.vec2d:
    """Pixel coordinates, of focal lengths and principal point in pixels.

    `axes` are the camera's in the world, the rows of cam_from_world. Only for modules that do not fuse multiply and
    add: a fused operation rounds once where NumPy rounds twice, which can move a landmark on the edge of a pixel or a
    bin to the next one.
    """
    depth = dot(axes[2], offset)
    x = focal[0] * (dot(axes[0], offset) / depth) + center[0]
    y = focal[1] * (dot(axes[1], offset) / depth) + center[1]
    return wp.vec2d(x, y)


@wp.func
def sign_of(x: wp.float32) -> wp.float32:
    return wp.where(x >= 0.0, 1.0, -1.0)


@wp.func
def cell_of(direction: wp.vec3, size: wp.int32) -> wp.int32:
    """Cell of a direction of any length but zero, on the octahedral map of size x size cells."""
    scale = 1.0 / (wp.abs(direction[0]) + wp.abs(direction[1]) + wp.abs(direction[2]))
    u = direction[0] * scale
    v = direction[1] * scale
    if direction[2] < 0.0:
        folded = (1.0 - wp.abs(v)) * sign_of(u)
        v = (1.0 - wp.abs(u)) * sign_of(v)
        u = folded
    half = 0.5 * wp.float32(size)
    column = wp.clamp(wp.int32((u + 1.0) * half), 0, size - 1)
    row = wp.clamp(wp.int32((v + 1.0) * half), 0, size - 1)
    return row * size + column


@wp.kernel
def collect_kernel(
    views: ViewBatch,
    write: wp.bool,
    out_starts: wp.array[wp.int32],
    lengths: wp.array[wp.int32],
    indices: wp.array[wp.int32],
):
    """Count the landmarks that each view sees and, with `write`, list them from `out_starts` on."""
    view = wp.tid()
    location = views.location_rows[view]
    count = wp.int32(0)
    left = views.sides[view, 0]
    right = views.sides[view, 1]
    top = views.sides[view, 2]
    bottom = views.sides[view, 3]
    for entry in range(views.starts[location], views.starts[location + 1]):
        offset = entry_offset(views, view, entry)
        # single precision rejects most; what is left, or not finite, is decided exactly
        outside = least_product(left, right, top, bottom, offset) < -rounding_error(offset, views.rounding)
        if not outside:  # noqa: SIM102 (Warp evaluates both sides of an `and`)
            if in_view(views.sides, view, offset, views.min_depth):
                if write:
                    indices[out_starts[view] + count] = views.unoccluded[entry]
                count += 1
    lengths[view] = count


@wp.kernel
def collect_field_kernel(
    rotations: wp.array[wp.mat33],
    centers: wp.array[wp.vec3d],
    location_rows: wp.array[wp.int32],
    points: wp.array[wp.vec3d],
    starts: wp.array[wp.int32],
    unoccluded: wp.array[wp.int32],
    depth: wp.array[wp.float32],
    field_size: wp.int32,
    write: wp.bool,
    first: wp.array[wp.int64],
    lengths: wp.array[wp.int64],
    indices: wp.array[wp.int32],
):
    """As `collect_kernel`, by a table of the field of view. What it cannot decide is listed as -1 - landmark."""
    view = wp.tid()
    location = location_rows[view]
    number = wp.int64(0)
    begin = wp.int64(0)
    if write:
        begin = first[view]
    for entry in range(starts[location], starts[location + 1]):
        landmark = unoccluded[entry]
        offset = offset_from(centers[view], points[landmark])
        if wp.isfinite(offset):
            distance = wp.length(offset)
            inside_by = wp.float32(0.0)
            if distance > 0.0 and distance < FAR:
                inside_by = depth[cell_of(rotations[view] * offset, field_size)]
            if inside_by >= 0.0:
                if write:
                    indices[begin + number] = wp.where(inside_by > 0.0, landmark, -1 - landmark)
                number += wp.int64(1)
    lengths[view] = number
