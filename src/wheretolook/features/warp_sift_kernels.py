"""Warp kernels of `WarpSift` up to its keypoints: the Gaussian scale space and its extrema (Lowe, IJCV 2004, 3 and 4).

Grey values are in 0..255. All levels of all octaves of a block of images lie in one array, see `Pyramid`.
"""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

LAYERS = wp.constant(3)
"""Layers an octave in which extrema are sought; it holds three more levels of the Gaussian."""
LEVELS = wp.constant(6)
BORDER = wp.constant(5)
"""No extremum is sought closer than this to an octave's border, in its pixels."""
STEPS = wp.constant(5)
"""Steps of refinement after which a candidate that still moves is dropped."""
SIGMA = wp.constant(1.6)

MAX_SIDE = wp.constant(1 << 14)
"""Rows or columns that a doubled image may have; with the two below, what a key is made of."""
MAX_OCTAVES = wp.constant(16)
MAX_LAYERS = wp.constant(4)
KEYS_OF_IMAGE = (1 << 14) ** 2 * 16 * 4


@wp.struct
class Pyramid:
    """Gaussian levels: image by image, octave by octave, level by level, row by row."""

    values: wp.array[wp.float32]
    image_size: wp.int32  # values an image
    starts: wp.array[wp.int32]  # first value of each octave of an image
    rows: wp.array[wp.int32]
    columns: wp.array[wp.int32]


@wp.struct
class Limits:
    """What a keypoint must pass."""

    pre_contrast: wp.float32  # of the extremum's own value, in 0..255
    contrast: wp.float32  # of the interpolated one, in 0..1
    edge: wp.float32  # ratio of principal curvatures


@wp.struct
class Peak:
    """A refined extremum of an octave: its pixel, and the offset from there."""

    found: wp.bool
    layer: wp.int32
    row: wp.int32
    column: wp.int32
    offset: wp.vec3  # columns, rows, layers
    response: wp.float32


@wp.kernel
def double_kernel(
    grey: wp.array3d[wp.uint8], values: wp.array[wp.float32], image_size: wp.int32, start: wp.int32, columns: wp.int32
):
    """Twice the size: pixel (2x, 2y) is (x, y), those between are interpolated linearly."""
    image, row, column = wp.tid()
    top = row >> 1
    left = column >> 1
    bottom = wp.min(top + (row & 1), grey.shape[1] - 1)
    right = wp.min(left + (column & 1), grey.shape[2] - 1)
    total = (
        wp.int32(grey[image, top, left])
        + wp.int32(grey[image, top, right])
        + wp.int32(grey[image, bottom, left])
        + wp.int32(grey[image, bottom, right])
    )
    values[image * image_size + start + row * columns + column] = 0.25 * wp.float32(total)


@wp.kernel
def halve_kernel(
    values: wp.array[wp.float32],
    image_size: wp.int32,
    source: wp.int32,
    source_columns: wp.int32,
    target: wp.int32,
    columns: wp.int32,
):
    """Every other pixel of every other row."""
    image, row, column = wp.tid()
    base = image * image_size
    values[base + target + row * columns + column] = values[base + source + 2 * (row * source_columns + column)]


@wp.func
def reflected(index: wp.int32, size: wp.int32):
    """An index beyond the border mirrored at the border's pixels, as often as it takes."""
    period = 2 * size - 2
    wrapped = wp.abs(index) % period
    return wp.min(wrapped, period - wrapped)


@wp.func
def smoothed(
    values: wp.array[wp.float32],
    start: wp.int32,
    stride: wp.int32,
    at: wp.int32,
    size: wp.int32,
    weights: wp.array[wp.float32],
    first_weight: wp.int32,
    radius: wp.int32,
):
    """The symmetric filter at one place of a line of values; `weights` from its middle outwards."""
    middle = start + at * stride
    total = weights[first_weight] * values[middle]
    if at >= radius and at + radius < size:
        for tap in range(1, radius + 1):
            total += weights[first_weight + tap] * (values[middle - tap * stride] + values[middle + tap * stride])
    else:
        for tap in range(1, radius + 1):
            before = values[start + reflected(at - tap, size) * stride]
            after = values[start + reflected(at + tap, size) * stride]
            total += weights[first_weight + tap] * (before + after)
    return total


@wp.kernel
def smooth_rows_kernel(
    values: wp.array[wp.float32],
    image_size: wp.int32,
    source: wp.int32,
    columns: wp.int32,
    weights: wp.array[wp.float32],
    first_weight: wp.int32,
    radius: wp.int32,
    half_smooth: wp.array[wp.float32],
    half_size: wp.int32,
):
    """Along each row of a level."""
    image, row, column = wp.tid()
    start = image * image_size + source + row * columns
    half_smooth[image * half_size + row * columns + column] = smoothed(
        values, start, 1, column, columns, weights, first_weight, radius
    )


@wp.kernel
def smooth_columns_kernel(
    half_smooth: wp.array[wp.float32],
    half_size: wp.int32,
    rows: wp.int32,
    columns: wp.int32,
    weights: wp.array[wp.float32],
    first_weight: wp.int32,
    radius: wp.int32,
    values: wp.array[wp.float32],
    image_size: wp.int32,
    target: wp.int32,
):
    """Along each column of what `smooth_rows_kernel` left."""
    image, row, column = wp.tid()
    start = image * half_size + column
    values[image * image_size + target + row * columns + column] = smoothed(
        half_smooth, start, columns, row, rows, weights, first_weight, radius
    )


@wp.func
def is_extremum(values: wp.array[wp.float32], at: wp.int32, size: wp.int32, columns: wp.int32, limit: wp.float32):
    """Whether the difference of Gaussians at `at` is the largest, or the smallest, of its 27 (equal ones allowed)."""
    value = values[at + size] - values[at]
    sign = wp.where(value > 0.0, 1.0, -1.0)
    highest = sign * value
    if highest <= limit:
        return False
    # its own neighbours along the row first, then layer by layer, until one is higher
    if sign * (values[at + size + 1] - values[at + 1]) > highest:
        return False
    if sign * (values[at + size - 1] - values[at - 1]) > highest:
        return False
    for layer in range(3):
        level = at + (wp.where(layer == 2, -1, layer)) * size
        for row in range(-1, 2):
            for column in range(-1, 2):
                near = level + row * columns + column
                if sign * (values[near + size] - values[near]) > highest:
                    return False
    return True


@wp.func
def difference(values: wp.array[wp.float32], at: wp.int32, size: wp.int32):
    """Difference of Gaussians in 0..1 (its level's and the next's)."""
    return (values[at + size] - values[at]) * (1.0 / 255.0)


@wp.func
def refined(
    pyramid: Pyramid,
    image: wp.int32,
    octave: wp.int32,
    layer: wp.int32,
    row: wp.int32,
    column: wp.int32,
    limits: Limits,
):
    """Where the parabola through an extremum and its neighbours has its own (Lowe 2004, section 4)."""
    peak = Peak()
    peak.found = False
    rows = pyramid.rows[octave]
    columns = pyramid.columns[octave]
    size = rows * columns
    start = image * pyramid.image_size + pyramid.starts[octave]
    values = pyramid.values
    offset = wp.vec3(0.0)
    gradient = wp.vec3(0.0)
    settled = wp.bool(False)
    inside = wp.bool(True)
    step = wp.int32(0)
    xx = wp.float32(0.0)
    yy = wp.float32(0.0)
    xy = wp.float32(0.0)
    middle = wp.float32(0.0)
    while inside and not settled and step < STEPS:
        at = start + layer * size + row * columns + column
        above = at + size
        below = at - size
        middle = difference(values, at, size)
        east = difference(values, at + 1, size)
        west = difference(values, at - 1, size)
        south = difference(values, at + columns, size)
        north = difference(values, at - columns, size)
        up = difference(values, above, size)
        down = difference(values, below, size)
        gradient = 0.5 * wp.vec3(east - west, south - north, up - down)
        xx = east + west - 2.0 * middle
        yy = south + north - 2.0 * middle
        ss = up + down - 2.0 * middle
        xy = 0.25 * (
            difference(values, at + columns + 1, size)
            - difference(values, at + columns - 1, size)
            - difference(values, at - columns + 1, size)
            + difference(values, at - columns - 1, size)
        )
        xs = 0.25 * (
            difference(values, above + 1, size)
            - difference(values, above - 1, size)
            - difference(values, below + 1, size)
            + difference(values, below - 1, size)
        )
        ys = 0.25 * (
            difference(values, above + columns, size)
            - difference(values, above - columns, size)
            - difference(values, below + columns, size)
            + difference(values, below - columns, size)
        )
        by_x = wp.vec3(xx, xy, xs)
        by_y = wp.vec3(xy, yy, ys)
        by_s = wp.vec3(xs, ys, ss)
        normal = wp.cross(by_y, by_s)
        determinant = wp.dot(by_x, normal)
        offset = wp.vec3(0.0)
        if determinant != 0.0:
            offset = (-1.0 / determinant) * wp.vec3(
                wp.dot(gradient, normal),
                wp.dot(gradient, wp.cross(by_s, by_x)),
                wp.dot(gradient, wp.cross(by_x, by_y)),
            )
        largest = wp.max(wp.abs(offset[0]), wp.max(wp.abs(offset[1]), wp.abs(offset[2])))
        if largest < 0.5:
            settled = True
        elif largest < 16384.0:  # far outside any image
            column += wp.int32(wp.rint(offset[0]))
            row += wp.int32(wp.rint(offset[1]))
            layer += wp.int32(wp.rint(offset[2]))
            inside = (
                layer >= 1
                and layer <= LAYERS
                and row >= BORDER
                and row < rows - BORDER
                and column >= BORDER
                and column < columns - BORDER
            )
        else:  # also where it is not a number
            inside = False
        step += 1
    if settled:
        response = wp.abs(middle + 0.5 * wp.dot(gradient, offset))
        trace = xx + yy
        determinant_xy = xx * yy - xy * xy
        edge_side = (limits.edge + 1.0) * (limits.edge + 1.0) * determinant_xy
        peak.found = response >= limits.contrast and determinant_xy > 0.0 and trace * trace * limits.edge < edge_side
        peak.layer = layer
        peak.row = row
        peak.column = column
        peak.offset = offset
        peak.response = response
    return peak


@wp.func
def key_of(image: wp.int32, octave: wp.int32, layer: wp.int32, row: wp.int32, column: wp.int32):
    """A place in the pyramids as one number, by which places are sorted."""
    level = (image * MAX_OCTAVES + octave) * MAX_LAYERS + layer
    return (wp.int64(level) * wp.int64(MAX_SIDE) + wp.int64(row)) * wp.int64(MAX_SIDE) + wp.int64(column)


@wp.func
def level_of(key: wp.int64):
    """Image, octave and layer of a key."""
    level = wp.int32(key / wp.int64(MAX_SIDE * MAX_SIDE))
    octave = level / MAX_LAYERS
    return wp.vec3i(octave / MAX_OCTAVES, octave % MAX_OCTAVES, level % MAX_LAYERS)


@wp.func
def pixel_of(key: wp.int64):
    """Column and row of a key."""
    pixel = wp.int32(key % wp.int64(MAX_SIDE * MAX_SIDE))
    return wp.vec2i(pixel % MAX_SIDE, pixel / MAX_SIDE)


@wp.kernel
def extrema_kernel(
    pyramid: Pyramid,
    octave: wp.int32,
    limits: Limits,
    number: wp.array[wp.int32],
    keys: wp.array[wp.int64],
):
    """List the keypoints of an octave, or only count them where the list is full, in any order and with repetitions.

    Several extrema can move to the same place in their refinement.
    """
    image, layer, row, column = wp.tid()
    layer += 1
    row += BORDER
    column += BORDER
    columns = pyramid.columns[octave]
    size = pyramid.rows[octave] * columns
    at = image * pyramid.image_size + pyramid.starts[octave] + layer * size + row * columns + column
    if is_extremum(pyramid.values, at, size, columns, limits.pre_contrast):
        peak = refined(pyramid, image, octave, layer, row, column, limits)
        if peak.found:
            slot = wp.atomic_add(number, 0, 1)
            if slot < keys.shape[0]:
                keys[slot] = key_of(image, octave, peak.layer, peak.row, peak.column)
