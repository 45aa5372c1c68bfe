"""Warp kernels of `WarpSift` that find the orientations of keypoints and describe them (Lowe, IJCV 2004, 5 and 6).

Each thread adds to its own histogram, so that sums have a fixed order.
"""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

from wheretolook.features.warp_sift_kernels import LAYERS, SIGMA, Limits, Pyramid, level_of, pixel_of, refined

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

ORIENTATION_BINS = wp.constant(36)  # of the histogram of directions near a keypoint
MAX_ORIENTATIONS = wp.constant(18)  # peaks that a histogram of 36 bins can have
HISTOGRAM_LANES = wp.constant(8)  # threads that share the rows near a keypoint
CELLS = wp.constant(4)  # along each side of a descriptor
CELL_BINS = wp.constant(8)  # directions in each
SIDE_OF_CELL = wp.constant(3.0)  # width of a descriptor's cell in standard deviations of the keypoint's Gaussian

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


PLACE_TYPES = {"level": wp.int32, "octave": wp.int32, "at": wp.vec2i, "centre": wp.vec2, "sigma": wp.float32}


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
    width = SIDE_OF_CELL * places.sigma[place]
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
