"""Warp kernel of `bin_views`."""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp


@wp.kernel
def bin_kernel(
    rotations: wp.array[wp.mat33],
    translations: wp.array[wp.vec3],
    location_rows: wp.array[wp.int32],
    points: wp.array[wp.vec3],
    starts: wp.array[wp.int32],
    indices: wp.array[wp.int32],
    focal: float,
    cx: float,
    cy: float,
    width: float,
    height: float,
    min_depth: float,
    bins: int,
    means: wp.array3d[wp.float32],
    counts: wp.array2d[wp.int32],
):
    view = wp.tid()
    rotation = rotations[view]
    translation = translations[view]
    location = location_rows[view]
    for entry in range(starts[location], starts[location + 1]):
        p = rotation * points[indices[entry]] + translation
        x = focal * p[0] + cx * p[2]
        y = focal * p[1] + cy * p[2]
        if p[2] > min_depth and x >= 0.0 and x < width * p[2] and y >= 0.0 and y < height * p[2]:
            u = x / p[2]
            v = y / p[2]
            column = wp.min(int(u * float(bins) / width), bins - 1)
            row = wp.min(int(v * float(bins) / height), bins - 1)
            cell = row * bins + column
            counts[view, cell] = counts[view, cell] + 1
            means[view, 0, cell] = means[view, 0, cell] + u
            means[view, 1, cell] = means[view, 1, cell] + v
            means[view, 2, cell] = means[view, 2, cell] + p[0]
            means[view, 3, cell] = means[view, 3, cell] + p[1]
            means[view, 4, cell] = means[view, 4, cell] + p[2]
    for cell in range(bins * bins):
        if counts[view, cell] > 1:
            scale = 1.0 / float(counts[view, cell])
            for channel in range(5):
                means[view, channel, cell] = means[view, channel, cell] * scale
