"""Warp kernels of `WarpRenderer` that rasterize, which on one core is about three times as fast as tracing rays.

Triangles are rasterized in homogeneous pixel coordinates (Olano and Greer, Triangle Scan Conversion using 2D
Homogeneous Coordinates, 1997), where a triangle that reaches behind the camera needs no clipping. Double precision and
coverage by pixel centres make each pixel show the triangle that its ray meets first.
"""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

from wheretolook.rendering.trace_kernel import Appearance, pixel_of, ray_through, shade

# Triangles are widened by this many pixels, so that rounding opens no gap between neighbours.
_SLACK = wp.constant(wp.float64(1.0e-9))
# Up to this sine of the angle between a triangle's plane and the camera, the camera counts as in the plane.
_FLAT = wp.constant(wp.float64(1.0e-13))


@wp.kernel(enable_backward=False)
def project_kernel(
    points: wp.array[wp.vec3],
    rotation: wp.array[wp.mat33d],
    offset: wp.array[wp.vec3d],
    projected: wp.array2d[wp.vec3d],
):
    b, i = wp.tid()
    at = wp.vec3d(wp.float64(points[i][0]), wp.float64(points[i][1]), wp.float64(points[i][2]))
    projected[b, i] = rotation[b] * at + offset[b]


@wp.func
def _within(span: wp.vec2d, slope: wp.float64, value: wp.float64):
    """The part of a span of x, (first, last), where slope * x + value >= 0."""
    if slope > wp.float64(0.0):
        span[0] = wp.max(span[0], -value / slope)
    elif slope < wp.float64(0.0):
        span[1] = wp.min(span[1], -value / slope)
    elif value < wp.float64(0.0):
        span[1] = wp.float64(-1.0)
    return span


@wp.kernel(enable_backward=False)
def raster_kernel(
    projected: wp.array2d[wp.vec3d], indices: wp.array[int], nearness: wp.array3d[float], triangle: wp.array3d[int]
):
    # One thread per triangle. That is safe only on the CPU, where the threads run one after the other.
    b, face = wp.tid()
    p0 = projected[b, indices[3 * face]]
    p1 = projected[b, indices[3 * face + 1]]
    p2 = projected[b, indices[3 * face + 2]]
    height = triangle.shape[1]
    width = triangle.shape[2]
    right = wp.float64(width)
    bottom = wp.float64(height)
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    if wp.max(p0[2], wp.max(p1[2], p2[2])) <= zero:
        return
    if wp.max(p0[0], wp.max(p1[0], p2[0])) < zero or wp.max(p0[1], wp.max(p1[1], p2[1])) < zero:
        return
    if wp.min(p0[0] - right * p0[2], wp.min(p1[0] - right * p1[2], p2[0] - right * p2[2])) > zero:
        return
    if wp.min(p0[1] - bottom * p0[2], wp.min(p1[1] - bottom * p1[2], p2[1] - bottom * p2[2])) > zero:
        return

    first_row = wp.int32(0)
    last_row = height - 1
    if wp.min(p0[2], wp.min(p1[2], p2[2])) > wp.float64(1.0e-6):
        y0 = p0[1] / p0[2]
        y1 = p1[1] / p1[2]
        y2 = p2[1] / p2[2]
        low = wp.max(wp.min(y0, wp.min(y1, y2)), zero)
        high = wp.min(wp.max(y0, wp.max(y1, y2)), bottom)
        first_row = wp.max(first_row, wp.int32(wp.ceil(low - half - _SLACK)))
        last_row = wp.min(last_row, wp.int32(wp.floor(high - half + _SLACK)))
        if first_row > last_row:
            return

    # Edge functions: the barycentric weights of the ray through (x, y), up to a common factor, are n . (x, y, 1).
    n0 = wp.cross(p1, p2)
    n1 = wp.cross(p2, p0)
    n2 = wp.cross(p0, p1)
    volume = wp.dot(p0, n0)
    if wp.abs(volume) <= _FLAT * wp.length(p0) * wp.length(n0):
        return  # edge-on: rounding would decide which side a pixel sees
    if volume < zero:
        n0 = -n0
        n1 = -n1
        n2 = -n2
        volume = -volume
    inverse_depth = (n0 + n1 + n2) / volume  # the scalar product with (x, y, 1) gives 1 / depth

    for row in range(first_row, last_row + 1):
        y = wp.float64(row) + half
        span = _within(wp.vec2d(zero, right), n0[0], n0[1] * y + n0[2])
        span = _within(span, n1[0], n1[1] * y + n1[2])
        span = _within(span, n2[0], n2[1] * y + n2[2])
        if span[0] > span[1] + _SLACK:
            continue
        begin = wp.max(0, wp.int32(wp.ceil(span[0] - half - _SLACK)))
        end = wp.min(width - 1, wp.int32(wp.floor(span[1] - half + _SLACK)))
        at_row = inverse_depth[1] * y + inverse_depth[2]
        for column in range(begin, end + 1):
            near = wp.float32(inverse_depth[0] * (wp.float64(column) + half) + at_row)
            if near > nearness[b, row, column]:
                nearness[b, row, column] = near
                triangle[b, row, column] = face


@wp.kernel(enable_backward=False)
def shade_kernel(
    projected: wp.array2d[wp.vec3d],
    vertices: wp.array[wp.vec3],
    triangle: wp.array3d[wp.int32],
    appearance: Appearance,
    ray_from_pixel: wp.array[wp.mat33],
    rgb: wp.array3d[wp.vec3ub],
    depth_m: wp.array3d[wp.float32],
):
    b, tile, within = wp.tid()
    pixel = pixel_of(tile, within, depth_m.shape[2])
    column = pixel[0]
    row = pixel[1]
    if column >= depth_m.shape[2] or row >= depth_m.shape[1]:
        return
    color = wp.vec3ub(wp.uint8(0), wp.uint8(0), wp.uint8(0))
    depth = wp.float32(0.0)
    face = triangle[b, row, column]
    if face >= 0:
        i0 = appearance.indices[3 * face]
        i1 = appearance.indices[3 * face + 1]
        i2 = appearance.indices[3 * face + 2]
        p0 = projected[b, i0]
        p1 = projected[b, i1]
        p2 = projected[b, i2]
        at = wp.vec3d(wp.float64(column) + wp.float64(0.5), wp.float64(row) + wp.float64(0.5), wp.float64(1.0))
        n0 = wp.cross(p1, p2)
        e0 = wp.dot(n0, at)
        e1 = wp.dot(wp.cross(p2, p0), at)
        e2 = wp.dot(wp.cross(p0, p1), at)
        total = e0 + e1 + e2
        weights = wp.vec3(wp.float32(e0 / total), wp.float32(e1 / total), wp.float32(e2 / total))
        depth = wp.float32(wp.dot(p0, n0) / total)
        corner = vertices[i0]
        normal = wp.normalize(wp.cross(vertices[i1] - corner, vertices[i2] - corner))
        direction = ray_through(ray_from_pixel[b], column, row)
        color = shade(appearance, face, weights, depth, normal, direction, ray_from_pixel[b])
    rgb[b, row, column] = color
    depth_m[b, row, column] = depth
