"""Warp kernel that adds up the information of the landmarks in view. The field-of-view test is the exact one."""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

from wheretolook.visibility.frustum_kernel import in_view, offset_from


@wp.kernel(enable_backward=False)
def information_kernel(
    sides: wp.array2d[wp.vec3],
    centers: wp.array[wp.vec3d],
    location_rows: wp.array[wp.int32],
    points: wp.array[wp.vec3d],
    starts: wp.array[wp.int32],
    candidates: wp.array[wp.int32],
    rounding: wp.float32,
    near_radius: wp.float32,
    min_depth: wp.float64,
    numbers: wp.array2d[wp.float64],
):
    view = wp.tid()
    location = location_rows[view]
    center = centers[view]
    left = sides[view, 0]
    right = sides[view, 1]
    top = sides[view, 2]
    bottom = sides[view, 3]
    count = wp.float64(0.0)
    near = wp.mat33d()  # sum of P / n^2
    toward = wp.vec3d()  # sum of f / n
    outer = wp.mat33d()  # sum of f f^T
    for entry in range(starts[location], starts[location + 1]):
        offset = offset_from(center, points[candidates[entry]])
        # in single precision first; within its rounding error of a side, or close to the camera, in double
        least = wp.min(
            wp.min(wp.dot(left, offset), wp.dot(right, offset)), wp.min(wp.dot(top, offset), wp.dot(bottom, offset))
        )
        error = rounding * (wp.abs(offset[0]) + wp.abs(offset[1]) + wp.abs(offset[2]))
        if least >= -error:
            seen = least > error and wp.length(offset) > near_radius
            if not seen:
                seen = in_view(sides, view, offset, min_depth)
            if seen:
                r = wp.vec3d(wp.float64(offset[0]), wp.float64(offset[1]), wp.float64(offset[2]))
                inverse = wp.float64(1.0) / wp.dot(r, r)
                product = wp.outer(r, r) * inverse
                near += (wp.identity(3, wp.float64) - product) * inverse
                toward += r * inverse
                outer += product
                count += wp.float64(1.0)
    across = wp.identity(3, wp.float64) * count - outer
    numbers[view, 0] = near[0, 0]
    numbers[view, 1] = near[0, 1]
    numbers[view, 2] = near[0, 2]
    numbers[view, 3] = near[1, 1]
    numbers[view, 4] = near[1, 2]
    numbers[view, 5] = near[2, 2]
    numbers[view, 6] = toward[0]
    numbers[view, 7] = toward[1]
    numbers[view, 8] = toward[2]
    numbers[view, 9] = across[0, 0]
    numbers[view, 10] = across[0, 1]
    numbers[view, 11] = across[0, 2]
    numbers[view, 12] = across[1, 1]
    numbers[view, 13] = across[1, 2]
    numbers[view, 14] = across[2, 2]
