"""Warp kernels that sum over the landmarks of listed views what their scores follow from.

For a landmark and a location, most units of the first layer are off, or on, wherever the landmark is in the image. What
those that are on add to the second layer is linear in that position, and computed once for all views of the location.
"""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

from functools import cache

import warp as wp

from wheretolook.scorers.set.network import CELLS, N_EXPECTED

OPTIONS = {"enable_backward": False, "cpu_compiler_flags": "-march=native -ffp-contract=fast"}

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
    # across and down
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
    const float* __restrict__ image = &wp::index(of_image, 0, 0);
    const float* __restrict__ location = &wp::index(of_location, 0, 0);
    const float* __restrict__ second = &wp::index(weights, 0, 0);
    const float* __restrict__ base = &wp::index(first, row, 0);
    float* __restrict__ sum = &wp::index(layers, entry, 0);
    for (int j = 0; j < W; ++j) {
        sum[j] = wp::index(bias, j);
        sum[W + j] = sum[2 * W + j] = 0.0f;
    }
    int n_open = 0;
    for (int unit = 0; unit < W; ++unit) {
        const float a = image[unit], b = image[W + unit];
        float value = base[unit];
        for (int k = 0; k < 4; ++k) value += values[k] * location[k * W + unit];
        const float range = reach[0] * wp::abs(a) + reach[1] * wp::abs(b);
        if (value >= range) {
            const float* __restrict__ weight = second + W * unit;
            for (int j = 0; j < W; ++j) {
                sum[j] += value * weight[j];
                sum[W + j] += a * weight[j];
                sum[2 * W + j] += b * weight[j];
            }
        } else if (value > -range) {
            wp::index(open, entry, n_open) = unit;
            sum[3 * W + n_open] = value;
            sum[4 * W + n_open] = a;
            sum[5 * W + n_open++] = b;
        }
    }
    return n_open;
"""

LOG_ODDS = """
    const float* __restrict__ second = &wp::index(weights, 0, 0);
    const float* __restrict__ out = &wp::index(last, 0);
    const float* __restrict__ base = &wp::index(layers, entry, 0);
    float sum[W];
    for (int j = 0; j < W; ++j) sum[j] = base[j] + at[0] * base[W + j] + at[1] * base[2 * W + j];
    float value[W];
    for (int j = 0; j < W; ++j)
        value[j] = wp::max(base[3 * W + j] + at[0] * base[4 * W + j] + at[1] * base[5 * W + j], 0.0f);
    for (int k = 0; k < n_open; ++k) {
        const float* __restrict__ weight = second + W * wp::index(open, entry, k);
        for (int j = 0; j < W; ++j) sum[j] += value[k] * weight[j];
    }
    float part[8] = {};  // so that the CPU adds eight at a time
    for (int j = 0; j < W; j += 8)
        for (int k = 0; k < 8; ++k) part[k] += wp::max(sum[j + k], 0.0f) * out[j + k];
    float log_odds = out[W];
    for (int k = 0; k < 8; ++k) log_odds += part[k];
    return log_odds;
"""


@cache
def kernels(width: int) -> tuple[wp.Kernel, wp.Kernel]:
    """Return `describe_kernel` and `sum_kernel` for layers of `width` units, a multiple of 8."""

    @wp.func_native(f"const int W = {width};{DESCRIBE}")
    def describe(
        entry: wp.int32,
        row: wp.int32,
        values: wp.vec4,
        first: wp.array2d[wp.float32],
        of_location: wp.array2d[wp.float32],
        of_image: wp.array2d[wp.float32],
        weights: wp.array2d[wp.float32],
        bias: wp.array[wp.float32],
        reach: wp.vec2,
        open: wp.array2d[wp.uint8],
        layers: wp.array2d[wp.float32],
    ) -> wp.int32: ...

    @wp.func_native(f"const int W = {width};{LOG_ODDS}")
    def log_odds_of(
        entry: wp.int32,
        n_open: wp.int32,
        at: wp.vec2,
        weights: wp.array2d[wp.float32],
        last: wp.array[wp.float32],
        open: wp.array2d[wp.uint8],
        layers: wp.array2d[wp.float32],
    ) -> wp.float32: ...

    @wp.kernel(module="unique", module_options=OPTIONS)
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
        described.n_open[entry] = describe(
            entry,
            row,
            values,
            network.first,
            network.of_location,
            network.of_image,
            network.second,
            network.bias,
            network.reach,
            described.open,
            described.layers,
        )
        described.terms[entry] = terms_of(offset, size_ratio, angle, network.pixel_angle, mapped)

    @wp.kernel(module="unique", module_options=OPTIONS)
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
        sums: wp.array[Sums],
        cells: wp.array[wp.float32],
    ):
        """Sum over the landmarks of each view; `none` (V, cells) is one, and for the probabilities of its cells."""
        view = wp.tid()
        total = Sums()
        for k in range(wp.int32(lengths[view])):
            number = starts[view] + wp.int64(k)
            entry = entries[number]
            at = image[number]
            log_odds = log_odds_of(
                entry, described.n_open[entry], at, network.second, network.last, described.open, described.layers
            )
            odds = wp.exp(wp.min(log_odds, 80.0))  # finite
            missed = 1.0 / (1.0 + odds)
            total += odds * missed * described.terms[entry]
            none[view, cell_along(at[1], edges) * CELLS + cell_along(at[0], edges)] *= missed
        each = n_visible[view] / wp.float32(wp.max(lengths[view], wp.int64(1)))
        expected = wp.float32(0.0)
        for cell in range(CELLS * CELLS):
            if none[view, cell] < 1.0:
                if each > 1.0:
                    none[view, cell] = wp.pow(none[view, cell], each)
                expected += 1.0 - none[view, cell]
        sums[view] = each * total
        cells[view] = expected

    return describe_kernel, sum_kernel
