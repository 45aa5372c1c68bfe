"""Warp kernels that compute poses from three matches, refine poses on all, and compare what they explain."""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
THREE = wp.constant(wp.float64(3.0))
mat34d = wp.types.matrix(shape=(3, 4), dtype=wp.float64)
mat77d = wp.types.matrix(shape=(7, 7), dtype=wp.float64)
vec7d = wp.types.vector(length=7, dtype=wp.float64)


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


@wp.func
def moved(pose: mat34d, point: wp.vec3d) -> wp.vec3d:
    return pose * wp.vec4d(point[0], point[1], point[2], ONE)


@wp.func
def row(point: wp.vec3d, by_point: wp.vec3d, error: wp.float64) -> vec7d:
    """Return the derivatives of an error by the rotation and translation of a pose, and the error."""
    turned = wp.cross(point, by_point)
    return vec7d(turned[0], turned[1], turned[2], by_point[0], by_point[1], by_point[2], error)


@wp.kernel
def refine_kernel(
    points: wp.array3d[wp.vec3d],
    keypoints: wp.array3d[wp.vec2d],
    focal: wp.vec2d,
    scale: wp.float64,
    steps: wp.int32,
    poses: wp.array2d[mat34d],
    costs: wp.array2d[wp.float64],
):
    """Replace poses by the best of so many Gauss-Newton steps with Cauchy weights, and set their costs, which are infinite.

    A block of threads refines the pose of a view and hypothesis; all hypotheses of a view may share its matches.
    """
    view, n, lane = wp.tid()
    pose = poses[view, n]
    if wp.isnan(pose[0, 0]):
        return
    matched = wp.min(n, points.shape[1] - 1)
    best = pose
    least = costs[view, n]
    for _ in range(steps):
        normal = mat77d()
        cost = ZERO
        for i in range(lane, points.shape[2], wp.block_dim()):
            point = moved(pose, points[view, matched, i])
            depth = point[2]
            error = wp.cw_mul(focal, wp.vec2d(point[0], point[1]) / depth - keypoints[view, matched, i])
            squared = wp.length_sq(error)
            if depth > wp.float64(1e-6) and squared < ONE:
                relative = ONE + squared / (scale * scale)
                cost += wp.log(relative)
                by_x = wp.vec3d(focal[0], ZERO, -focal[0] * point[0] / depth) / depth
                by_y = wp.vec3d(ZERO, focal[1], -focal[1] * point[1] / depth) / depth
                of_x = row(point, by_x, error[0])
                of_y = row(point, by_y, error[1])
                normal += wp.outer(of_x, of_x / relative) + wp.outer(of_y, of_y / relative)
            else:
                cost += wp.log(ONE + ONE / (scale * scale))
        cost = wp.tile_sum(wp.tile(cost))[0]
        normal = wp.tile_sum(wp.tile(normal, preserve_type=True))[0]
        if cost < least:
            least = cost
            best = pose
        for k in range(6):  # Gauss's elimination: the matrix is positive definite
            for below in range(k + 1, 6):
                normal[below] = normal[below] - normal[k] * (normal[below, k] / normal[k, k])
        change = vec7d()
        change[6] = -ONE
        for upwards in range(6):
            k = 5 - upwards
            change[k] = -wp.dot(normal[k], change) / normal[k, k]
        half = wp.skew(wp.vec3d(change[0], change[1], change[2])) / wp.float64(2.0)
        identity = wp.identity(n=3, dtype=wp.float64)
        pose = wp.inverse(identity + half) * (identity - half) * pose  # Cayley's rotation
        for k in range(3):
            pose[k, 3] = pose[k, 3] - change[k + 3]
    if lane == 0:
        poses[view, n] = best
        costs[view, n] = least


@wp.kernel
def unexplained_kernel(
    grid: wp.uint64,
    landmarks: wp.array[wp.vec3],
    radius: wp.float32,
    points: wp.array3d[wp.vec3d],
    inliers: wp.array3d[wp.bool],
    poses: wp.array2d[mat34d],
    unexplained: wp.array4d[wp.bool],
):
    """Mark the inliers (V, S, M) of each pose for which another pose (V, S, S, M) shows no landmark within a radius there."""
    view, n, other, i = wp.tid()
    theirs = poses[view, other]
    if n == other or not inliers[view, n, i] or wp.isnan(theirs[0, 0]):
        return
    in_camera = moved(poses[view, n], points[view, wp.min(n, points.shape[1] - 1), i])
    offset = in_camera - wp.vec3d(theirs[0, 3], theirs[1, 3], theirs[2, 3])
    turned = wp.transpose(theirs) * offset
    place = wp.vec3(wp.vec3d(turned[0], turned[1], turned[2]))
    for near in wp.hash_grid_query(grid, place, radius):
        if wp.length(landmarks[near] - place) < radius:
            return
    unexplained[view, n, other, i] = True
