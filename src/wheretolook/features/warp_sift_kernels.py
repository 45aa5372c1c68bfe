"""Warp kernels of SIFT: scale space, extrema, orientations and descriptors."""

from __future__ import annotations

from functools import cache

import warp as wp

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.


wp.set_module_options({"enable_backward": False, "fuse_fp": False})

LAYERS = wp.constant(3)  # of each octave, searched for extrema
LEVELS = wp.constant(6)  # of the Gaussian in each octave
BORDER = wp.constant(5)  # distance in pixels from an octave's border that is not searched for extrema
SIGMA = wp.constant(1.6)  # of an octave's first level, in its pixels

MAX_SIDE = wp.constant(1 << 14)  # rows or columns of a doubled image; with the two below it makes up a key
MAX_OCTAVES = wp.constant(16)
MAX_LAYERS = wp.constant(4)


@wp.struct
class Pyramid:
    """Gaussian levels: image by image, octave by octave, level by level, row by row."""

    values: wp.array[wp.float32]
    image_size: wp.int32  # number of values of an image
    starts: wp.array[wp.int32]  # first value of each octave of an image
    rows: wp.array[wp.int32]
    columns: wp.array[wp.int32]


@wp.struct
class Level:
    """A level of an octave, of all images."""

    values: wp.array[wp.float32]
    image_size: wp.int32  # values an image
    start: wp.int32  # first value of the level in an image
    rows: wp.int32
    columns: wp.int32


@wp.struct
class Limits:
    """Thresholds that a keypoint must pass."""

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


@wp.func
def place_in(level: Level, image: wp.int32, row: wp.int32, column: wp.int32):
    """Index of the value of a pixel."""
    return image * level.image_size + level.start + row * level.columns + column


@wp.kernel
def double_kernel(grey: wp.array3d[wp.uint8], target: Level):
    """Double the size: pixel (2x, 2y) is pixel (x, y), those between are interpolated linearly."""
    image, row, column = wp.tid()
    top = row >> 1
    left = column >> 1
    bottom = wp.min(top + (row & 1), grey.shape[1] - 1)
    right = wp.min(left + (column & 1), grey.shape[2] - 1)
    total = wp.int32(grey[image, top, left]) + wp.int32(grey[image, top, right])
    total += wp.int32(grey[image, bottom, left]) + wp.int32(grey[image, bottom, right])
    target.values[place_in(target, image, row, column)] = 0.25 * wp.float32(total)


@wp.kernel
def halve_kernel(source: Level, target: Level):
    """Take every other pixel of every other row."""
    image, row, column = wp.tid()
    target.values[place_in(target, image, row, column)] = source.values[place_in(source, image, 2 * row, 2 * column)]


@wp.func
def reflected(index: wp.int32, size: wp.int32):
    """An index beyond the border mirrored at the border's pixels, as often as needed."""
    period = 2 * size - 2
    wrapped = wp.abs(index) % period
    return wp.min(wrapped, period - wrapped)


@cache
def smooth_kernel(radius: int, along_rows: bool):
    """Create the kernel that smooths each row, or else each column, of a level by a symmetric filter of a radius.

    With a known radius the compiler unrolls the loop over the filter, which takes a third of the time.
    """

    @wp.kernel
    def smooth(source: Level, target: Level, weights: wp.array[wp.float32], first: wp.int32):
        """Smooth by a filter whose weights, from its middle outwards, start at `first`."""
        image, row, column = wp.tid()
        step = wp.int32(1)
        at = column
        size = source.columns
        if wp.static(not along_rows):
            step = source.columns
            at = row
            size = source.rows
        middle = place_in(source, image, row, column)
        total = weights[first] * source.values[middle]
        if at >= wp.static(radius) and at + wp.static(radius) < size:
            for tap in range(1, wp.static(radius + 1)):
                pair = source.values[middle - tap * step] + source.values[middle + tap * step]
                total += weights[first + tap] * pair
        else:
            start = middle - at * step
            for tap in range(1, wp.static(radius + 1)):
                before = source.values[start + reflected(at - tap, size) * step]
                after = source.values[start + reflected(at + tap, size) * step]
                total += weights[first + tap] * (before + after)
        target.values[place_in(target, image, row, column)] = total

    return smooth


@wp.func
def is_extremum(values: wp.array[wp.float32], at: wp.int32, size: wp.int32, columns: wp.int32, limit: wp.float32):
    """Whether the difference of Gaussians at `at` is the largest or smallest in its 3 x 3 x 3 neighbourhood."""
    value = values[at + size] - values[at]
    sign = wp.where(value > 0.0, 1.0, -1.0)
    highest = sign * value
    if highest <= limit:
        return False
    # the neighbours along the row first, then layer by layer, until one is higher
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
    """Difference of Gaussians in 0..1, of the next level and this one."""
    return (values[at + size] - values[at]) * (1.0 / 255.0)


@wp.func
def mixed(values: wp.array[wp.float32], at: wp.int32, a: wp.int32, b: wp.int32, size: wp.int32):
    """Mixed second derivative of the difference of Gaussians along the strides a and b."""
    same = difference(values, at + a + b, size) - difference(values, at + a - b, size)
    return 0.25 * (same - difference(values, at - a + b, size) + difference(values, at - a - b, size))


@wp.func
def refined(pyramid: Pyramid, image: int, octave: int, layer: int, row: int, column: int, limits: Limits):
    """The extremum of the parabola through a discrete extremum and its neighbours (Lowe 2004, section 4)."""
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
    while inside and not settled and step < 5:  # a candidate that still moves is dropped
        at = start + layer * size + row * columns + column
        middle = difference(values, at, size)
        east = difference(values, at + 1, size)
        west = difference(values, at - 1, size)
        south = difference(values, at + columns, size)
        north = difference(values, at - columns, size)
        up = difference(values, at + size, size)
        down = difference(values, at - size, size)
        gradient = 0.5 * wp.vec3(east - west, south - north, up - down)
        xx = east + west - 2.0 * middle
        yy = south + north - 2.0 * middle
        ss = up + down - 2.0 * middle
        xy = mixed(values, at, columns, 1, size)
        xs = mixed(values, at, size, 1, size)
        ys = mixed(values, at, size, columns, size)
        by_x = wp.vec3(xx, xy, xs)
        by_y = wp.vec3(xy, yy, ys)
        by_s = wp.vec3(xs, ys, ss)
        normal = wp.cross(by_y, by_s)
        determinant = wp.dot(by_x, normal)
        offset = wp.vec3(0.0)
        if determinant != 0.0:
            along_y = wp.dot(gradient, wp.cross(by_s, by_x))
            along_s = wp.dot(gradient, wp.cross(by_x, by_y))
            offset = (-1.0 / determinant) * wp.vec3(wp.dot(gradient, normal), along_y, along_s)
        largest = wp.max(wp.abs(offset[0]), wp.max(wp.abs(offset[1]), wp.abs(offset[2])))
        if largest < 0.5:
            settled = True
        elif largest < 16384.0:  # far outside any image
            column += wp.int32(wp.rint(offset[0]))
            row += wp.int32(wp.rint(offset[1]))
            layer += wp.int32(wp.rint(offset[2]))
            inside = layer >= 1 and layer <= LAYERS and row >= BORDER and row < rows - BORDER
            inside = inside and column >= BORDER and column < columns - BORDER
        else:  # also if it is NaN
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
    """Image, octave, layer and pixel as one number, by which keypoints are sorted."""
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
def extrema_kernel(pyramid: Pyramid, octave: int, limits: Limits, number: wp.array[int], keys: wp.array[wp.int64]):
    """List the keypoints of an octave in any order, or only count them once the list is full.

    A keypoint can be listed several times, since the refinement can move several extrema to the same place.
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


ORIENTATION_BINS = wp.constant(36)  # of the histogram of directions near a keypoint
HISTOGRAM_LANES = wp.constant(8)  # threads that share the rows near a keypoint
CELLS = wp.constant(4)  # along each side of a descriptor
CELL_BINS = wp.constant(8)  # directions in each

OrientationHistogram = wp.types.vector(length=36, dtype=wp.float32)
CellHistogram = wp.types.vector(length=8, dtype=wp.float32)


@wp.struct
class Places:
    """Keypoints in their octaves."""

    level: wp.array[wp.int32]  # first value of its Gaussian level in the pyramids
    octave: wp.array[wp.int32]
    at: wp.array[wp.vec2i]  # column, row
    centre: wp.array[wp.vec2]  # column, row, refined
    sigma: wp.array[wp.float32]  # standard deviation of its Gaussian, in pixels of the octave


@wp.kernel
def place_kernel(
    pyramid: Pyramid, keys: wp.array[wp.int64], limits: Limits, places: Places, table: wp.array2d[wp.float32]
):
    """The keypoints at sorted keys; x, y, scale in pixels of the image (0 at the first one's centre), response."""
    row = wp.tid()
    key = keys[row]
    level = level_of(key)
    pixel = pixel_of(key)
    octave = level[1]
    peak = refined(pyramid, level[0], octave, level[2], pixel[1], pixel[0], limits)
    size = pyramid.rows[octave] * pyramid.columns[octave]
    x = wp.float32(peak.column) + peak.offset[0]
    y = wp.float32(peak.row) + peak.offset[1]
    sigma = SIGMA * wp.pow(2.0, (wp.float32(peak.layer) + peak.offset[2]) / wp.float32(LAYERS))
    places.level[row] = level[0] * pyramid.image_size + pyramid.starts[octave] + peak.layer * size
    places.octave[row] = octave
    places.at[row] = wp.vec2i(peak.column, peak.row)
    places.centre[row] = wp.vec2(x, y)
    places.sigma[row] = sigma
    pixels = 0.5 * wp.float32(1 << octave)  # pixels of the image in a pixel of the octave
    table[row, 0] = x * pixels
    table[row, 1] = y * pixels
    table[row, 2] = sigma * pixels
    table[row, 3] = peak.response


@wp.func
def gradient_at(values: wp.array[wp.float32], at: wp.int32, columns: wp.int32):
    """Twice the gradient, x to the right and y up."""
    return wp.vec2(values[at + 1] - values[at - 1], values[at - columns] - values[at + columns])


@wp.func
def in_turns(gradient: wp.vec2):
    """Direction of a gradient as a share of a full turn, from 0 to 1."""
    turns = wp.atan2(gradient[1], gradient[0]) * (0.5 / wp.pi)
    return wp.where(turns < 0.0, turns + 1.0, turns)


@wp.kernel
def orientation_histogram_kernel(pyramid: Pyramid, places: Places, histograms: wp.array3d[wp.float32]):
    """Histogram of the directions of the gradients near a keypoint, in every `HISTOGRAM_LANES`-th row."""
    row, lane = wp.tid()
    octave = places.octave[row]
    rows = pyramid.rows[octave]
    columns = pyramid.columns[octave]
    level = places.level[row]
    at = places.at[row]
    spread = 1.5 * places.sigma[row]
    radius = wp.int32(wp.rint(3.0 * spread))
    fall = -0.5 / (spread * spread)
    left = wp.max(-radius, 1 - at[0])
    right = wp.min(radius, columns - 2 - at[0])
    histogram = OrientationHistogram()
    for down in range(lane - radius, radius + 1, HISTOGRAM_LANES):
        y = at[1] + down
        if y > 0 and y < rows - 1:
            for across in range(left, right + 1):
                gradient = gradient_at(pyramid.values, level + y * columns + at[0] + across, columns)
                weight = wp.exp(fall * wp.float32(across * across + down * down))
                turn = wp.int32(wp.rint(in_turns(gradient) * wp.float32(ORIENTATION_BINS)))
                if turn >= ORIENTATION_BINS:
                    turn -= ORIENTATION_BINS
                histogram[turn] += weight * wp.length(gradient)
    for turn in range(ORIENTATION_BINS):
        histograms[row, lane, turn] = histogram[turn]


@wp.kernel
def orientation_kernel(
    histograms: wp.array3d[wp.float32], n_orientations: wp.array[wp.int32], angles: wp.array2d[wp.float32]
):
    """Peaks of the smoothed histogram, in degrees clockwise from the image's x axis, as OpenCV's."""
    row = wp.tid()
    histogram = OrientationHistogram()
    for turn in range(ORIENTATION_BINS):
        total = wp.float32(0.0)
        for lane in range(HISTOGRAM_LANES):
            total += histograms[row, lane, turn]
        histogram[turn] = total
    smooth = OrientationHistogram()
    highest = wp.float32(0.0)
    for turn in range(ORIENTATION_BINS):
        next = histogram[(turn + 1) % ORIENTATION_BINS] + histogram[(turn + ORIENTATION_BINS - 1) % ORIENTATION_BINS]
        second = histogram[(turn + 2) % ORIENTATION_BINS] + histogram[(turn + ORIENTATION_BINS - 2) % ORIENTATION_BINS]
        value = (second + 4.0 * next + 6.0 * histogram[turn]) * 0.0625
        smooth[turn] = value
        highest = wp.max(highest, value)
    number = wp.int32(0)
    for turn in range(ORIENTATION_BINS):
        value = smooth[turn]
        before = smooth[(turn + ORIENTATION_BINS - 1) % ORIENTATION_BINS]
        after = smooth[(turn + 1) % ORIENTATION_BINS]
        if value > before and value > after and value >= 0.8 * highest:
            peak = wp.float32(turn) + 0.5 * (before - after) / (before - 2.0 * value + after)
            peak = wp.where(peak < 0.0, peak + wp.float32(ORIENTATION_BINS), peak)
            angle = 360.0 - peak * (360.0 / wp.float32(ORIENTATION_BINS))
            if angle >= 360.0 or angle <= 0.0:
                angle = 0.0
            angles[row, number] = angle
            number += 1
    n_orientations[row] = number


@wp.kernel
def describe_kernel(
    pyramid: Pyramid, places: Places, chosen: wp.array[int], angles: wp.array[float], histograms: wp.array2d[float]
):
    """One cell of a descriptor: histogram of the gradients less than a cell's width from its centre."""
    row, cell = wp.tid()
    place = chosen[row]
    octave = places.octave[place]
    rows = pyramid.rows[octave]
    columns = pyramid.columns[octave]
    level = places.level[place]
    centre = places.centre[place]
    x = wp.int32(wp.rint(centre[0]))
    y = wp.int32(wp.rint(centre[1]))
    width = 3.0 * places.sigma[place]  # of a cell
    turned = (360.0 - angles[row]) / 360.0
    cosine = wp.cos(turned * 2.0 * wp.pi)
    sine = wp.sin(turned * 2.0 * wp.pi)
    # the cell's centre, in cells from the keypoint along the descriptor's own axes, and in pixels
    cell_x = wp.float32(cell % CELLS) - 1.5
    cell_y = wp.float32(cell / CELLS) - 1.5
    middle_x = width * (cosine * cell_x + sine * cell_y)
    middle_y = width * (cosine * cell_y - sine * cell_x)
    reach = width * (wp.abs(cosine) + wp.abs(sine))
    radius = wp.rint(width * (2.5 * wp.sqrt(2.0)))
    diagonal = wp.sqrt(wp.float32(rows * rows + columns * columns))
    radius = wp.min(radius, wp.floor(diagonal))
    left = wp.max(wp.int32(wp.max(wp.ceil(middle_x - reach), -radius)), 1 - x)
    right = wp.min(wp.int32(wp.min(wp.floor(middle_x + reach), radius)), columns - 2 - x)
    top = wp.max(wp.int32(wp.max(wp.ceil(middle_y - reach), -radius)), 1 - y)
    bottom = wp.min(wp.int32(wp.min(wp.floor(middle_y + reach), radius)), rows - 2 - y)
    cosine /= width
    sine /= width
    histogram = CellHistogram()
    for down in range(top, bottom + 1):
        for across in range(left, right + 1):
            right_by = wp.float32(across) * cosine - wp.float32(down) * sine
            down_by = wp.float32(across) * sine + wp.float32(down) * cosine
            share_x = 1.0 - wp.abs(right_by - cell_x)
            share_y = 1.0 - wp.abs(down_by - cell_y)
            if share_x > 0.0 and share_y > 0.0:
                gradient = gradient_at(pyramid.values, level + (y + down) * columns + x + across, columns)
                weight = wp.exp((right_by * right_by + down_by * down_by) * -0.125)
                weight *= share_x * share_y * wp.length(gradient)
                direction = (in_turns(gradient) - turned) * wp.float32(CELL_BINS)
                lower = wp.floor(direction)
                part = weight * (direction - lower)
                first = (wp.int32(lower) + CELL_BINS) & (CELL_BINS - 1)
                histogram[first] += weight - part
                histogram[(first + 1) & (CELL_BINS - 1)] += part
    for direction in range(CELL_BINS):
        histograms[row, cell * CELL_BINS + direction] = histogram[direction]


@wp.kernel
def finish_kernel(histograms: wp.array2d[wp.float32], descriptors: wp.array2d[wp.float32]):
    """Round descriptors to bytes as OpenCV does, then take RootSIFT of them (Arandjelovic, Zisserman, CVPR 2012)."""
    row = wp.tid()
    size = histograms.shape[1]
    square = wp.float32(0.0)
    for k in range(size):
        square += histograms[row, k] * histograms[row, k]
    limit = 0.2 * wp.sqrt(square)
    square = wp.float32(0.0)
    for k in range(size):
        value = wp.min(histograms[row, k], limit)
        square += value * value
    scale = 512.0 / wp.max(wp.sqrt(square), 1.2e-7)
    total = wp.float32(0.0)
    for k in range(size):
        value = wp.min(wp.rint(wp.min(histograms[row, k], limit) * scale), 255.0)
        descriptors[row, k] = value
        total += value
    # roots of numbers that sum to 1 have unit length, up to rounding
    total = wp.max(total, 1.0e-12)
    for k in range(size):
        descriptors[row, k] = wp.sqrt(descriptors[row, k] / total)
