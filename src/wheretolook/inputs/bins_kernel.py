"""Warp kernels of `bin_views` and `count_bins`."""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

from wheretolook.mapping.attribute_names import MAP_ATTRIBUTES
from wheretolook.visibility.frustum_kernel import Views, dot, entry_offset, in_view, pixel_of

wp.set_module_options({"enable_backward": False, "fuse_fp": False})  # the latter for `pixel_of`

MAPPED_DISTANCE = wp.constant(MAP_ATTRIBUTES.index("mapped_distance"))


@wp.struct
class BinGrid:
    """A grid of bins x bins cells over a pinhole's image, and how B views are turned."""

    rotations: wp.array[wp.mat33]  # (B,) cam_from_world
    focal: wp.vec2d  # pixels
    center: wp.vec2d  # principal point, pixels
    columns_per_pixel: wp.float64
    rows_per_pixel: wp.float64
    bins: wp.int32


@wp.func
def pixel_in(grid: BinGrid, view: wp.int32, offset: wp.vec3) -> wp.vec2d:
    return pixel_of(grid.rotations[view], offset, grid.focal, grid.center)


@wp.func
def cell_of(grid: BinGrid, pixel: wp.vec2d) -> wp.int32:
    """Cell that a pixel falls into, counted row by row."""
    column = wp.clamp(wp.int32(pixel[0] * grid.columns_per_pixel), 0, grid.bins - 1)
    row = wp.clamp(wp.int32(pixel[1] * grid.rows_per_pixel), 0, grid.bins - 1)
    return row * grid.bins + column


@wp.kernel
def bin_kernel(
    views: Views,
    grid: BinGrid,
    directions: wp.array[wp.vec3],
    attributes: wp.array2d[wp.float32],  # (0, .) if they are not asked for
    means: wp.array3d[wp.float32],
    counts: wp.array2d[wp.int32],
):
    """Number of landmarks in each cell of each view, and the mean of their channels."""
    view = wp.tid()
    rotation = grid.rotations[view]
    location = views.location_rows[view]
    for entry in range(views.starts[location], views.starts[location + 1]):
        landmark = views.unoccluded[entry]
        offset = entry_offset(views, view, entry)
        if in_view(views.sides, view, offset, views.min_depth):
            pixel = pixel_in(grid, view, offset)
            cell = cell_of(grid, pixel)
            counts[view, cell] = counts[view, cell] + 1
            means[view, 0, cell] = means[view, 0, cell] + wp.float32(pixel[0])
            means[view, 1, cell] = means[view, 1, cell] + wp.float32(pixel[1])
            for axis in range(3):
                means[view, 2 + axis, cell] = means[view, 2 + axis, cell] + wp.float32(dot(rotation[axis], offset))
            if attributes.shape[0] > 0:
                distance = wp.sqrt(dot(offset, offset))
                angle = wp.float32(dot(offset, directions[landmark]) / distance)
                ratio = wp.float32(wp.log(distance) - wp.float64(attributes[landmark, MAPPED_DISTANCE]))
                means[view, 5, cell] = means[view, 5, cell] + angle
                means[view, 6, cell] = means[view, 6, cell] + ratio
                for attribute in range(attributes.shape[1]):
                    value = attributes[landmark, attribute]
                    means[view, 7 + attribute, cell] = means[view, 7 + attribute, cell] + value
    for cell in range(grid.bins * grid.bins):
        if counts[view, cell] > 1:
            scale = 1.0 / wp.float32(counts[view, cell])
            for channel in range(means.shape[1]):
                means[view, channel, cell] = means[view, channel, cell] * scale


@wp.kernel
def count_bins_kernel(
    views: Views,
    grid: BinGrid,
    lanes: wp.int32,
    occupied: wp.array2d[wp.int32],  # 0 where no landmark has been seen in a bin yet
    n_in_view: wp.array[wp.int32],
    n_filled: wp.array[wp.int32],
):
    """Number of landmarks in each view, and of bins with at least one. Several threads (lanes) share a view."""
    view, lane = wp.tid()
    location = views.location_rows[view]
    seen = wp.int32(0)
    filled = wp.int32(0)
    for entry in range(views.starts[location] + lane, views.starts[location + 1], lanes):
        offset = entry_offset(views, view, entry)
        if in_view(views.sides, view, offset, views.min_depth):
            seen += 1
            # whichever lane comes first fills the bin, so the numbers do not depend on the lanes' order
            if wp.atomic_max(occupied, view, cell_of(grid, pixel_in(grid, view, offset)), 1) == 0:
                filled += 1
    wp.atomic_add(n_in_view, view, seen)
    wp.atomic_add(n_filled, view, filled)
