"""Warp kernels that sum over the landmarks of listed views what their scores follow from.

For a landmark and a location, most units of the first layer are off, or on, wherever the landmark is in the image. What
those that are on add to the second layer is linear in that position, and computed once for all views of the location.
Threads side by side on a GPU are faster where all do the same: there nothing is computed in advance, and several lanes
share the landmarks of a view.
"""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

from functools import cache

import warp as wp

from wheretolook.scorers.set.network import CELLS, N_EXPECTED

Mapped = wp.types.vector(7, wp.float32)
Sums = wp.types.vector(N_EXPECTED, wp.float32)
LOG_320 = wp.constant(5.768321)  # see `bearing_precision`


@wp.struct
class Matchability:
    """A network of N landmarks of a map, with W units in both layers; inputs of layers are rows of their weights."""

    first: wp.array2d[wp.float32]  # (N, W) of the attributes that depend on the map alone
    of_location: wp.array2d[wp.float32]  # (4, W) of `OF_LOCATION`
    of_image: wp.array2d[wp.float32]  # (2, W) of `OF_IMAGE`
    second: wp.array2d[wp.float32]  # (W, W)
    bias: wp.array[wp.float32]  # (W,)
    last: wp.array[wp.float32]  # (W + 1,) and its bias
    mean: wp.vec4  # of `OF_LOCATION`
    pixel_angle: wp.float32  # log
    # direction, distance and pixel size that landmarks were mapped from, 1 / track length, `along` their spread
    mapped: wp.array[Mapped]
    reach: wp.vec2  # the largest positions in an image, across and down


@wp.struct
class Described:
    """The M landmarks that are unoccluded from locations."""

    n_open: wp.array[wp.int32]  # (M,) units of the first layer that are on in a part of the image
    open: wp.array2d[wp.uint8]  # (M, W) these units
    # (M, 6 W): the second layer without open units, and these, each in the centre of the image, and what they gain
    # across and down; on a GPU (W, M) the first layer in the centre of the image
    layers: wp.array2d[wp.float32]
    terms: wp.array[Sums]  # (M,) of `expected_parts`, for a detected landmark


@wp.func
def known(x: wp.float32) -> wp.float32:
    return wp.where(wp.isnan(x), 0.0, x)


@wp.func
def terms_of(offset: wp.vec3, size_ratio: wp.float32, angle: wp.float32, pixel: wp.float32, mapped: Mapped) -> Sums:
    inverse = 1.0 / wp.length(offset)
    f = offset * inverse
    noise = wp.exp(-2.0 * (pixel + LOG_320))
    ratio = wp.exp(-2.0 * known(size_ratio))
    weight = noise / (1.0 + ratio)
    track = noise / (1.0 + ratio * mapped[5] * (1.0 + 0.5 * mapped[6] * (1.0 - angle * angle)))
    terms = Sums()
    terms[0] = 1.0
    terms[10] = weight * (1.0 - f[0] * f[0])
    terms[11] = -weight * f[0] * f[1]
    terms[12] = -weight * f[0] * f[2]
    terms[13] = weight * (1.0 - f[1] * f[1])
    terms[14] = -weight * f[1] * f[2]
    terms[15] = weight * (1.0 - f[2] * f[2])
    for axis in range(3):
        terms[7 + axis] = weight * inverse * f[axis]
    for number in range(6):
        terms[1 + number] = terms[10 + number] * inverse * inverse
    terms[16] = track * inverse * inverse
    terms[17] = track
    return terms


@wp.func
def cell_along(x: wp.float32, edges: wp.array[wp.float64]) -> wp.int32:
    """Cell of a position across or down: by an angle to 0.004 rad, then by edges in double precision."""
    slope = wp.min(wp.abs(x), 1.0 / wp.abs(x))
    angle = slope * (1.058398 - 0.273 * slope)  # Rajan et al., Efficient approximations for the arctangent, 2006
    if wp.abs(x) > 1.0:
        angle = wp.HALF_PI - angle
    cell = wp.clamp(wp.int32((wp.sign(x) * angle / wp.PI + 0.5) * wp.float32(CELLS)), 0, CELLS - 1)
    if wp.float64(x) < edges[cell]:
        cell -= 1
    elif wp.float64(x) >= edges[cell + 1]:
        cell += 1
    return cell


DESCRIBE = """
    const float* __restrict__ image = &wp::index(network.of_image, 0, 0);
    const float* __restrict__ location = &wp::index(network.of_location, 0, 0);
    const float* __restrict__ second = &wp::index(network.second, 0, 0);
    const float* __restrict__ base = &wp::index(network.first, row, 0);
    float* __restrict__ sum = &wp::index(described.layers, entry, 0);
    for (int j = 0; j < W; ++j) {
        sum[j] = wp::index(network.bias, j);
        sum[W + j] = sum[2 * W + j] = 0.0f;
    }
    int n_open = 0;
    for (int unit = 0; unit < W; ++unit) {
        const float a = image[unit], b = image[W + unit];
        float value = base[unit];
        for (int k = 0; k < 4; ++k) value += values[k] * location[k * W + unit];
        const float range = network.reach[0] * wp::abs(a) + network.reach[1] * wp::abs(b);
        if (value >= range) {
            const float* __restrict__ weight = second + W * unit;
            for (int j = 0; j < W; ++j) {
                sum[j] += value * weight[j];
                sum[W + j] += a * weight[j];
                sum[2 * W + j] += b * weight[j];
            }
        } else if (value > -range) {
            wp::index(described.open, entry, n_open) = unit;
            sum[3 * W + n_open] = value;
            sum[4 * W + n_open] = a;
            sum[5 * W + n_open++] = b;
        }
    }
    return n_open;
"""

LOG_ODDS = """
    const float* __restrict__ second = &wp::index(network.second, 0, 0);
    const float* __restrict__ out = &wp::index(network.last, 0);
    const float* __restrict__ base = &wp::index(described.layers, entry, 0);
    float sum[W];
    for (int j = 0; j < W; ++j) sum[j] = base[j] + at[0] * base[W + j] + at[1] * base[2 * W + j];
    float value[W];
    for (int j = 0; j < W; ++j)
        value[j] = wp::max(base[3 * W + j] + at[0] * base[4 * W + j] + at[1] * base[5 * W + j], 0.0f);
    for (int k = 0; k < wp::index(described.n_open, entry); ++k) {
        const float* __restrict__ weight = second + W * wp::index(described.open, entry, k);
        for (int j = 0; j < W; ++j) sum[j] += value[k] * weight[j];
    }
    float part[8] = {};  // so that the CPU adds eight at a time
    for (int j = 0; j < W; j += 8)
        for (int k = 0; k < 8; ++k) part[k] += wp::max(sum[j + k], 0.0f) * out[j + k];
    float log_odds = out[W];
    for (int k = 0; k < 8; ++k) log_odds += part[k];
    return log_odds;
"""

DESCRIBE_ALL = """
    for (int unit = 0; unit < W; ++unit) {
        float value = wp::index(network.first, row, unit);
        for (int k = 0; k < 4; ++k) value += values[k] * wp::index(network.of_location, k, unit);
        wp::index(described.layers, unit, entry) = value;
    }
    return W;
"""

LOG_ODDS_ALL = """
    const float* __restrict__ image = &wp::index(network.of_image, 0, 0);
    const float* __restrict__ second = &wp::index(network.second, 0, 0);
    const float* __restrict__ out = &wp::index(network.last, 0);
    float sum[W];
    #pragma unroll
    for (int j = 0; j < W; ++j) sum[j] = wp::index(network.bias, j);
    for (int unit = 0; unit < W; ++unit) {
        const float there = wp::index(described.layers, unit, entry) + at[0] * image[unit] + at[1] * image[W + unit];
        const float value = wp::max(there, 0.0f);
        #pragma unroll
        for (int j = 0; j < W; ++j) sum[j] += value * second[W * unit + j];
    }
    float log_odds = out[W];
    #pragma unroll
    for (int j = 0; j < W; ++j) log_odds += wp::max(sum[j], 0.0f) * out[j];
    return log_odds;
"""


@cache
def kernels(width: int, lanes: int) -> tuple[wp.Kernel, wp.Kernel]:
    """Return `describe_kernel` and `sum_kernel` for layers of `width` units, a multiple of 8; with lanes those of a GPU."""
    describe_text, log_odds_text = (DESCRIBE, LOG_ODDS) if lanes == 1 else (DESCRIBE_ALL, LOG_ODDS_ALL)
    module = f"{__name__}.{width}x{lanes}"  # one for both: each takes seconds to compile
    options = {"enable_backward": False, "cpu_compiler_flags": "-march=native -ffp-contract=fast"}
    wp.set_module_options(options, module)

    @wp.func_native(f"const int W = {width};{describe_text}")
    def describe(
        network: Matchability, described: Described, entry: wp.int32, row: wp.int32, values: wp.vec4
    ) -> wp.int32: ...

    @wp.func_native(f"const int W = {width};{log_odds_text}")
    def log_odds_of(network: Matchability, described: Described, entry: wp.int32, at: wp.vec2) -> wp.float32: ...

    @wp.kernel(module=module)
    def describe_kernel(
        network: Matchability, offsets: wp.array[wp.vec3], rows: wp.array[wp.int32], described: Described
    ):
        entry = wp.tid()
        row = rows[entry]
        offset = offsets[entry]
        mapped = network.mapped[row]
        distance = wp.length(offset)
        log_distance = wp.log(distance)
        angle = (offset[0] * mapped[0] + offset[1] * mapped[1] + offset[2] * mapped[2]) / distance
        size_ratio = log_distance + network.pixel_angle - mapped[4]
        values = wp.vec4(log_distance, angle, log_distance - mapped[3], size_ratio) - network.mean
        for k in range(4):
            values[k] = known(values[k])
        described.n_open[entry] = describe(network, described, entry, row, values)
        described.terms[entry] = terms_of(offset, size_ratio, angle, network.pixel_angle, mapped)

    @wp.kernel(module=module)
    def sum_kernel(
        network: Matchability,
        described: Described,
        starts: wp.array[wp.int64],
        lengths: wp.array[wp.int64],
        entries: wp.array[wp.int32],
        image: wp.array[wp.vec2],
        n_visible: wp.array[wp.float32],
        edges: wp.array[wp.float64],
        none: wp.array2d[wp.float32],
        sums: wp.array2d[Sums],
        cells: wp.array[wp.float32],
    ):
        """Sum over every lanes-th landmark of each view.

        `none` (V, cells), 1, gets the probabilities that none is detected in a cell; with lanes their logs, from 0 on.
        """
        view, lane = wp.tid()
        total = Sums()
        for k in range(lane, wp.int32(lengths[view]), lanes):
            number = starts[view] + wp.int64(k)
            entry = entries[number]
            at = image[number]
            odds = wp.exp(wp.min(log_odds_of(network, described, entry, at), 80.0))  # finite
            missed = 1.0 / (1.0 + odds)
            total += odds * missed * described.terms[entry]
            cell = cell_along(at[1], edges) * CELLS + cell_along(at[0], edges)
            if wp.static(lanes == 1):
                none[view, cell] *= missed
            else:
                wp.atomic_add(none, view, cell, wp.log(missed))
        sums[view, lane] = total
        if wp.static(lanes == 1):
            each = n_visible[view] / wp.float32(wp.max(lengths[view], wp.int64(1)))
            expected = wp.float32(0.0)
            for cell in range(CELLS * CELLS):
                if none[view, cell] < 1.0:
                    if each > 1.0:
                        none[view, cell] = wp.pow(none[view, cell], each)
                    expected += 1.0 - none[view, cell]
            cells[view] = expected

    return describe_kernel, sum_kernel
