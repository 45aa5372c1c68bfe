"""Warp kernels that render by rays and by rasterization."""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

# Up to this ratio of a pixel footprint's axes, several samples along the long axis replace a coarser mip level. 8 keeps
# floors and walls sharp that are seen at a slant.
MAX_ANISOTROPY = wp.constant(8)
TILE = wp.constant(8)


@wp.struct
class TexturedTriangles:
    corner_uvs: wp.array2d[wp.vec2]
    texel_gradients: wp.array2d[wp.vec3]
    triangle_texture: wp.array[wp.int32]
    texels: wp.array[wp.uint32]
    level_start: wp.array2d[wp.int32]
    texture_size: wp.array2d[wp.int32]
    indices: wp.array[wp.int32]
    vertex_colors: wp.array[wp.vec3]


@wp.func
def _byte(value: float):
    return wp.uint8(wp.clamp(value + 0.5, 0.0, 255.0))


@wp.func
def _texel(texels: wp.array[wp.uint32], index: wp.int32):
    red = texels[index] & wp.uint32(255)
    green = (texels[index] >> wp.uint32(8)) & wp.uint32(255)
    blue = (texels[index] >> wp.uint32(16)) & wp.uint32(255)
    return wp.vec3(wp.float32(red), wp.float32(green), wp.float32(blue))


@wp.func
def _bilinear(a: TexturedTriangles, texture: wp.int32, level: wp.int32, uv: wp.vec2):
    """Colour at uv in one mip level, the texture repeated."""
    width = wp.max(1, a.texture_size[texture, 0] >> level)
    height = wp.max(1, a.texture_size[texture, 1] >> level)
    x = (uv[0] - wp.floor(uv[0])) * wp.float32(width) - 0.5
    y = (uv[1] - wp.floor(uv[1])) * wp.float32(height) - 0.5
    x0 = wp.int32(wp.floor(x))
    y0 = wp.int32(wp.floor(y))
    fx = x - wp.float32(x0)
    fy = y - wp.float32(y0)
    # x0 is in [-1, width - 1] (or width, by rounding): one wrap each way is enough.
    left = wp.where(x0 < 0, width - 1, wp.where(x0 >= width, x0 - width, x0))
    top = wp.where(y0 < 0, height - 1, wp.where(y0 >= height, y0 - height, y0))
    right = wp.where(left + 1 == width, 0, left + 1)
    bottom = wp.where(top + 1 == height, 0, top + 1)
    start = a.level_start[texture, level]
    row0 = start + top * width
    row1 = start + bottom * width
    upper = (1.0 - fx) * _texel(a.texels, row0 + left) + fx * _texel(a.texels, row0 + right)
    lower = (1.0 - fx) * _texel(a.texels, row1 + left) + fx * _texel(a.texels, row1 + right)
    return (1.0 - fy) * upper + fy * lower


@wp.func
def shade(
    a: TexturedTriangles,
    face: int,
    weights: wp.vec3,
    depth_m: float,
    normal: wp.vec3,
    direction: wp.vec3,
    to_ray: wp.mat33,
):
    """Colour of a hit, filtered over the pixel's footprint."""
    uv = weights[0] * a.corner_uvs[face, 0] + weights[1] * a.corner_uvs[face, 1] + weights[2] * a.corner_uvs[face, 2]
    texture = a.triangle_texture[face]

    # How far the hit moves on the plane, in metres, as the pixel moves by one to the right and by one down.
    by_x = wp.vec3(to_ray[0, 0], to_ray[1, 0], to_ray[2, 0])
    by_y = wp.vec3(to_ray[0, 1], to_ray[1, 1], to_ray[2, 1])
    slant = wp.dot(normal, direction)
    if wp.abs(slant) < 1.0e-4:
        slant = wp.where(slant < 0.0, -1.0e-4, 1.0e-4)
    step_x = depth_m * (by_x - direction * (wp.dot(normal, by_x) / slant))
    step_y = depth_m * (by_y - direction * (wp.dot(normal, by_y) / slant))
    # The same in texels: the columns of the footprint matrix J.
    grad_x = a.texel_gradients[face, 0]
    grad_y = a.texel_gradients[face, 1]
    j00 = wp.dot(grad_x, step_x)
    j10 = wp.dot(grad_y, step_x)
    j01 = wp.dot(grad_x, step_y)
    j11 = wp.dot(grad_y, step_y)
    # Axes of the footprint's ellipse from J J^T = [[p, q], [q, r]].
    p = j00 * j00 + j01 * j01
    q = j00 * j10 + j01 * j11
    r = j10 * j10 + j11 * j11
    root = wp.sqrt((p - r) * (p - r) + 4.0 * q * q)
    major = wp.sqrt(0.5 * (p + r + root))
    minor = wp.abs(j00 * j11 - j01 * j10) / wp.max(major, 1.0e-12)
    width = wp.max(wp.max(minor, major / wp.float32(MAX_ANISOTROPY)), 1.0)
    n_taps = wp.clamp(wp.int32(wp.floor(major / width + 0.5)), 1, MAX_ANISOTROPY)
    axis = wp.vec2(0.5 * (p - r + root), q)
    if p < r:
        axis = wp.vec2(q, 0.5 * (r - p + root))
    axis = axis * (major / wp.max(wp.length(axis), 1.0e-12))
    along = wp.vec2(axis[0] / wp.float32(a.texture_size[texture, 0]), axis[1] / wp.float32(a.texture_size[texture, 1]))

    last = a.texture_size[texture, 2] - 1
    level = wp.min(wp.log2(width), wp.float32(last))
    fine = wp.int32(wp.floor(level))
    blend = level - wp.float32(fine)
    color = wp.vec3(0.0, 0.0, 0.0)
    for tap in range(n_taps):
        at = uv + ((wp.float32(tap) + 0.5) / wp.float32(n_taps) - 0.5) * along
        sample = _bilinear(a, texture, fine, at)
        if blend > 0.0:
            sample = (1.0 - blend) * sample + blend * _bilinear(a, texture, wp.min(fine + 1, last), at)
        color += sample
    color = color / wp.float32(n_taps)

    if a.vertex_colors.shape[0] > 0:
        first = a.vertex_colors[a.indices[3 * face]]
        second = a.vertex_colors[a.indices[3 * face + 1]]
        third = a.vertex_colors[a.indices[3 * face + 2]]
        color = wp.cw_mul(color, weights[0] * first + weights[1] * second + weights[2] * third)
    return wp.vec3ub(_byte(color[0]), _byte(color[1]), _byte(color[2]))


@wp.func
def pixel_of(tile: wp.int32, within: wp.int32, width: wp.int32):
    """Column and row of a thread. Threads run tile by tile, so that neighbours read the same nodes and texels."""
    tiles_across = (width + TILE - 1) / TILE
    return wp.vec2i((tile % tiles_across) * TILE + within % TILE, (tile / tiles_across) * TILE + within / TILE)


@wp.func
def ray_through(to_ray: wp.mat33, column: wp.int32, row: wp.int32):
    """Direction of the ray through a pixel's centre, of length 1 along the optical axis."""
    return to_ray * wp.vec3(wp.float32(column) + 0.5, wp.float32(row) + 0.5, 1.0)


@wp.kernel(enable_backward=False)
def trace_kernel(
    mesh: wp.uint64,
    appearance: TexturedTriangles,
    centers: wp.array[wp.vec3],
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
    direction = ray_through(ray_from_pixel[b], column, row)
    hit = wp.mesh_query_ray(mesh, centers[b], direction, 1.0e6)
    color = wp.vec3ub(wp.uint8(0), wp.uint8(0), wp.uint8(0))
    depth = wp.float32(0.0)
    if hit.result:
        depth = hit.t
        weights = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)  # Warp gives those of the first and second corner
        color = shade(appearance, hit.face, weights, depth, hit.normal, direction, ray_from_pixel[b])
    rgb[b, row, column] = color
    depth_m[b, row, column] = depth


# Triangles are widened by this many pixels, so that rounding opens no gap between neighbours.
_SLACK = wp.constant(wp.float64(1.0e-9))


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
    # up to a sine of 1e-13 of the angle between the triangle's plane and the camera, the camera counts as in the plane
    if wp.abs(volume) <= wp.float64(1.0e-13) * wp.length(p0) * wp.length(n0):
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
    appearance: TexturedTriangles,
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
