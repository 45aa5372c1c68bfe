"""Warp kernels of `bin_views` and `count_bins`."""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

from wheretolook.mapping.attribute_names import MAP_ATTRIBUTES
from wheretolook.visibility.frustum_kernel import dot, in_view, offset_from, pixel_of

wp.set_module_options({"fuse_fp": False})  # for `pixel_of`

MAPPED_DISTANCE = wp.constant(MAP_ATTRIBUTES.index("mapped_distance"))


@wp.func
def cell_of(pixel: wp.vec2d, columns_per_pixel: wp.float64, rows_per_pixel: wp.float64, bins: wp.int32) -> wp.int32:
    """Which of bins x bins cells of the image, row by row."""
    column = wp.clamp(wp.int32(pixel[0] * columns_per_pixel), 0, bins - 1)
    row = wp.clamp(wp.int32(pixel[1] * rows_per_pixel), 0, bins - 1)
    return row * bins + column


@wp.kernel
def bin_kernel(
    sides: wp.array2d[wp.vec3],
    rotations: wp.array[wp.mat33],
    centers: wp.array[wp.vec3d],
    location_rows: wp.array[wp.int32],
    points: wp.array[wp.vec3d],
    directions: wp.array[wp.vec3],
    attributes: wp.array2d[wp.float32],  # of no landmark where they are not asked for
    starts: wp.array[wp.int32],
    indices: wp.array[wp.int32],
    focal: wp.float64,
    cx: wp.float64,
    cy: wp.float64,
    columns_per_pixel: wp.float64,
    rows_per_pixel: wp.float64,
    min_depth: wp.float64,
    bins: wp.int32,
    means: wp.array3d[wp.float32],
    counts: wp.array2d[wp.int32],
):
    view = wp.tid()
    rotation = rotations[view]
    center = centers[view]
    location = location_rows[view]
    for entry in range(starts[location], starts[location + 1]):
        landmark = indices[entry]
        offset = offset_from(center, points[landmark])
        if in_view(sides, view, offset, min_depth):
            pixel = pixel_of(rotation, offset, focal, cx, cy)
            cell = cell_of(pixel, columns_per_pixel, rows_per_pixel, bins)
            counts[view, cell] = counts[view, cell] + 1
            means[view, 0, cell] = means[view, 0, cell] + wp.float32(pixel[0])
            means[view, 1, cell] = means[view, 1, cell] + wp.float32(pixel[1])
            means[view, 2, cell] = means[view, 2, cell] + wp.float32(dot(rotation[0], offset))
            means[view, 3, cell] = means[view, 3, cell] + wp.float32(dot(rotation[1], offset))
            means[view, 4, cell] = means[view, 4, cell] + wp.float32(dot(rotation[2], offset))
            if attributes.shape[0] > 0:
                distance = wp.sqrt(dot(offset, offset))
                angle = wp.float32(dot(offset, directions[landmark]) / distance)
                ratio = wp.float32(wp.log(distance) - wp.float64(attributes[landmark, MAPPED_DISTANCE]))
                means[view, 5, cell] = means[view, 5, cell] + angle
                means[view, 6, cell] = means[view, 6, cell] + ratio
                for column_of_map in range(attributes.shape[1]):
                    value = attributes[landmark, column_of_map]
                    means[view, 7 + column_of_map, cell] = means[view, 7 + column_of_map, cell] + value
    for cell in range(bins * bins):
        if counts[view, cell] > 1:
            scale = 1.0 / wp.float32(counts[view, cell])
            for channel in range(means.shape[1]):
                means[view, channel, cell] = means[view, channel, cell] * scale


@wp.kernel
def count_bins_kernel(
    sides: wp.array2d[wp.vec3],
    rotations: wp.array[wp.mat33],
    centers: wp.array[wp.vec3d],
    location_rows: wp.array[wp.int32],
    points: wp.array[wp.vec3d],
    starts: wp.array[wp.int32],
    indices: wp.array[wp.int32],
    focal: wp.float64,
    cx: wp.float64,
    cy: wp.float64,
    columns_per_pixel: wp.float64,
    rows_per_pixel: wp.float64,
    min_depth: wp.float64,
    bins: wp.int32,
    lanes: wp.int32,
    taken: wp.array2d[wp.int32],  # 0 where no landmark has been seen in a bin yet
    n_visible: wp.array[wp.int32],
    n_filled: wp.array[wp.int32],
):
    view, lane = wp.tid()
    rotation = rotations[view]
    center = centers[view]
    location = location_rows[view]
    visible = wp.int32(0)
    filled = wp.int32(0)
    for entry in range(starts[location] + lane, starts[location + 1], lanes):
        offset = offset_from(center, points[indices[entry]])
        if in_view(sides, view, offset, min_depth):
            pixel = pixel_of(rotation, offset, focal, cx, cy)
            cell = cell_of(pixel, columns_per_pixel, rows_per_pixel, bins)
            visible += 1
            # whichever lane comes first fills the bin: the numbers do not depend on their order
            if wp.atomic_max(taken, view, cell, 1) == 0:
                filled += 1
    wp.atomic_add(n_visible, view, visible)
    wp.atomic_add(n_filled, view, filled)
