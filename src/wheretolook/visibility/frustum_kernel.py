"""Warp kernel of `count_in_frustum`."""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp


@wp.kernel
def count_kernel(
    rotations: wp.array[wp.mat33],
    locations: wp.array[wp.vec3],
    points: wp.array[wp.vec3],
    starts: wp.array[wp.int32],
    indices: wp.array[wp.int32],
    focal: float,
    cx: float,
    cy: float,
    width: float,
    height: float,
    min_depth: float,
    counts: wp.array2d[wp.int32],
):
    location, direction = wp.tid()
    rotation = rotations[direction]
    center = locations[location]
    count = wp.int32(0)
    for entry in range(starts[location], starts[location + 1]):
        p = rotation * (points[indices[entry]] - center)
        # pixel bounds multiplied by the depth: no division
        x = focal * p[0] + cx * p[2]
        y = focal * p[1] + cy * p[2]
        if p[2] > min_depth and x >= 0.0 and x < width * p[2] and y >= 0.0 and y < height * p[2]:
            count += 1
    counts[location, direction] = count
