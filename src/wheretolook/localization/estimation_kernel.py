"""Warp kernel that computes and scores the poses that three matches of an image determine."""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
THREE = wp.constant(wp.float64(3.0))


@wp.func
def largest_row(matrix: wp.mat33d) -> wp.vec3d:
    best = matrix[0]
    for n in range(1, 3):
        if wp.length_sq(matrix[n]) > wp.length_sq(best):
            best = matrix[n]
    return best


@wp.func
def cofactors(matrix: wp.mat33d) -> wp.mat33d:
    x = matrix[0]
    y = matrix[1]
    z = matrix[2]
    return wp.matrix_from_rows(wp.cross(y, z), wp.cross(z, x), wp.cross(x, y))


@wp.func
def cubic_root(b: wp.float64, c: wp.float64, d: wp.float64) -> wp.float64:
    """Find the outermost root of a cubic on its side of the inflection by Newton's method, which converges from outside."""
    x = ONE + wp.abs(b) + wp.abs(c) + wp.abs(d)
    bend = -b / THREE
    if ((bend + b) * bend + c) * bend + d > ZERO:
        x = -x
    for _ in range(50):
        x -= (((x + b) * x + c) * x + d) / ((THREE * x + b + b) * x + c)
    return x


@wp.func
def product_with_itself(x: wp.vec3d, y: wp.vec3d, z: wp.vec3d) -> wp.mat33d:
    columns = wp.matrix_from_cols(x, y, z)
    return wp.transpose(columns) * columns


@wp.func
def frame(x: wp.vec3d, y: wp.vec3d) -> wp.mat33d:
    return wp.matrix_from_cols(x, y, wp.cross(x, y))


@wp.kernel
def p3p_kernel(
    points: wp.array2d[wp.vec3d],
    keypoints: wp.array2d[wp.vec3d],
    focal: wp.vec3d,
    counts: wp.array[wp.int32],
    drawn: wp.array2d[wp.vec3i],
    costs: wp.array3d[wp.float64],
    turns: wp.array3d[wp.mat33d],
    shifts: wp.array3d[wp.vec3d],
):
    """Compute the at most four poses that explain three matches of an image, and score each by all its matches.

    Keypoints are on the plane at depth 1; focal lengths, and 0, are in units of the error limit. The cost sums squared errors,
    each at most 1 (MSAC). The depths along the rays are zeros of a pencil of conics. One of the pencil is a pair of lines,
    and each meets the others twice (Lambda Twist, Persson and Nordberg, ECCV 2018; Ding et al., CVPR 2023).
    """
    view, trial = wp.tid()
    if counts[view] < 3:
        return
    chosen = drawn[view, trial]
    start = points[view, chosen[0]]
    x = points[view, chosen[1]] - start
    y = points[view, chosen[2]] - start
    squared = wp.vec3d(wp.length_sq(x), wp.length_sq(y), wp.length_sq(x - y))
    ray = keypoints[view, chosen[0]]
    ray_x = keypoints[view, chosen[1]]
    ray_y = keypoints[view, chosen[2]]
    none = wp.vec3d()
    # quadratic forms of squared distances in the depths
    by_x = product_with_itself(ray, -ray_x, none)
    by_y = product_with_itself(ray, none, -ray_y)
    across = product_with_itself(none, ray_x, -ray_y)
    conic = squared[2] * by_x - squared[0] * across
    other = squared[2] * by_y - squared[1] * across
    leading = wp.determinant(other)
    lines = conic + other * cubic_root(
        wp.ddot(conic, cofactors(other)) / leading,
        wp.ddot(cofactors(conic), other) / leading,
        wp.determinant(conic) / leading,
    )
    crossing = -cofactors(lines)  # the product of the point where they cross with itself
    lines += wp.skew(wp.normalize(largest_row(crossing)) * wp.sqrt(wp.trace(crossing)))  # the product of both lines
    for n in range(4):
        if n == 2:
            lines = wp.transpose(lines)
        line = largest_row(lines)
        u = largest_row(wp.skew(line))  # two points on the line
        v = wp.cross(line, u)
        a = wp.dot(u, other * u)
        b = wp.dot(u, other * v)
        c = wp.dot(v, other * v)
        q = -b - wp.sign(b) * wp.sqrt(b * b - a * c)
        depths = q * u + a * v
        if n % 2 == 1:
            depths = c * u + q * v
        scale = (squared[0] + squared[1] + squared[2]) / wp.dot(depths, (by_x + by_y + across) * depths)
        depths *= wp.sign(depths[0]) * wp.sqrt(scale)
        for _ in range(4):  # Newton's method
            half = wp.matrix_from_rows(by_x * depths, by_y * depths, across * depths)
            depths -= wp.inverse(half + half) * (half * depths - squared)
        shift = depths[0] * ray
        turn = frame(depths[1] * ray_x - shift, depths[2] * ray_y - shift) * wp.inverse(frame(x, y))
        if wp.min(depths) > ZERO and wp.abs(wp.determinant(turn) - ONE) < wp.float64(1e-6):
            shift -= turn * start
            cost = ZERO
            for i in range(counts[view]):
                in_camera = turn * points[view, i] + shift
                error = wp.cw_mul(focal, in_camera / in_camera[2] - keypoints[view, i])
                cost += wp.where(in_camera[2] > ZERO, wp.min(ONE, wp.length_sq(error)), ONE)
            costs[view, trial, n] = cost
            turns[view, trial, n] = turn
            shifts[view, trial, n] = shift
