"""Warp kernel that sums the information of the landmarks in view. The field-of-view test is the exact one."""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

from wheretolook.visibility.frustum_kernel import ViewBatch, entry_offset, in_view, least_product, rounding_error


@wp.kernel(enable_backward=False)
def information_kernel(
    views: ViewBatch, rounding: wp.float32, near_radius: wp.float32, numbers: wp.array2d[wp.float64]
):
    """The 15 numbers of each view, see `wheretolook.geometry.pose_information`."""
    view = wp.tid()
    location = views.location_rows[view]
    left = views.sides[view, 0]
    right = views.sides[view, 1]
    top = views.sides[view, 2]
    bottom = views.sides[view, 3]
    count = wp.float64(0.0)
    near = wp.mat33d()  # sum of P / n^2
    toward = wp.vec3d()  # sum of f / n
    outer = wp.mat33d()  # sum of f f^T
    for entry in range(views.starts[location], views.starts[location + 1]):
        offset = entry_offset(views, view, entry)
        # single precision decides unless the landmark is within its rounding error of a side, or near the camera
        least = least_product(left, right, top, bottom, offset)
        error = rounding_error(offset, rounding)
        if least >= -error:
            seen = least > error and wp.length(offset) > near_radius
            if not seen:
                seen = in_view(views.sides, view, offset, views.min_depth)
            if seen:
                r = wp.vec3d(wp.float64(offset[0]), wp.float64(offset[1]), wp.float64(offset[2]))
                inverse = wp.float64(1.0) / wp.dot(r, r)
                product = wp.outer(r, r) * inverse
                near += (wp.identity(3, wp.float64) - product) * inverse
                toward += r * inverse
                outer += product
                count += wp.float64(1.0)
    across = wp.identity(3, wp.float64) * count - outer
    number = wp.int32(0)
    for i in range(3):
        numbers[view, 6 + i] = toward[i]
        for j in range(i, 3):
            numbers[view, number] = near[i, j]
            numbers[view, 9 + number] = across[i, j]
            number += 1
