"""Warp kernels that sum a Fisher Information Field.

On a CPU one instruction works on sixteen numbers: vectors are as long as AVX-512 registers, and multiply and add are
fused.
"""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

from wheretolook.visibility.frustum_kernel import offset_from

wp.set_module_options(
    {"enable_backward": False, "cpu_compiler_flags": "-march=native -mprefer-vector-width=512 -ffp-contract=fast"}
)

vec16 = wp.types.vector(length=16, dtype=wp.float32)
mat10x16 = wp.types.matrix(shape=(10, 16), dtype=wp.float32)
mat15x16 = wp.types.matrix(shape=(15, 16), dtype=wp.float32)


@wp.kernel
def numbers_kernel(
    locations: wp.array[wp.vec3d],
    points: wp.array[wp.vec3d],
    masked: wp.bool,
    unoccluded: wp.array2d[wp.bool],
    nearest: wp.float32,
    bearings: wp.array2d[wp.vec3],
    numbers: wp.array2d[vec16],
):
    """The 15 numbers of every landmark at every location; zero if it is occluded or too near."""
    location, landmark = wp.tid()
    free = wp.bool(True)
    if masked:
        free = unoccluded[location, landmark]
    bearing = wp.vec3()
    n = vec16()
    if free:
        offset = offset_from(locations[location], points[landmark])
        distance = wp.length(offset)
        if distance > nearest:
            inverse = 1.0 / distance
            bearing = offset * inverse
            x = bearing[0]
            y = bearing[1]
            z = bearing[2]
            square = inverse * inverse
            n[6] = x * inverse
            n[7] = y * inverse
            n[8] = z * inverse
            n[9] = 1.0 - x * x
            n[10] = -x * y
            n[11] = -x * z
            n[12] = 1.0 - y * y
            n[13] = -y * z
            n[14] = 1.0 - z * z
            for i in range(6):
                n[i] = n[9 + i] * square
    bearings[location, landmark] = bearing
    numbers[location, landmark] = n


@wp.kernel
def quadratic_kernel(
    bearings: wp.array2d[wp.vec3], numbers: wp.array2d[vec16], at_once: wp.int32, sums: wp.array3d[vec16]
):
    """Sums, over a part of the landmarks, of the numbers times xx, xy, xz, yy, yz, zz, x, y, z and 1 of the bearing."""
    location, part = wp.tid()
    total = mat10x16()
    for landmark in range(part * at_once, wp.min((part + 1) * at_once, bearings.shape[1])):
        f = bearings[location, landmark]
        n = numbers[location, landmark]
        total[0] += n * (f[0] * f[0])
        total[1] += n * (f[0] * f[1])
        total[2] += n * (f[0] * f[2])
        total[3] += n * (f[1] * f[1])
        total[4] += n * (f[1] * f[2])
        total[5] += n * (f[2] * f[2])
        for axis in range(3):
            total[6 + axis] += n * f[axis]
        total[9] += n
    for factor in range(10):
        sums[location, part, factor] = total[factor]


@wp.func
def soft_step(x: vec16) -> vec16:
    """1 / (1 + exp(-2 x)) = (1 + tanh x) / 2, to about 1e-7.

    By the best rational approximation of tanh of this degree on [0, 8.3], found by Lawson's iteration, which errs by
    8e-9; beyond 8.3, tanh differs from 1 by less than 1.3e-7.
    """
    limit = vec16(8.3)
    y = wp.max(wp.min(x, limit), -limit)
    square = wp.cw_mul(y, y)
    above = wp.cw_mul(vec16(1.447869970e-08), square) + vec16(2.138220519e-05)
    above = wp.cw_mul(above, square) + vec16(3.541271294e-03)
    above = wp.cw_mul(above, square) + vec16(1.341912892e-01)
    above = wp.cw_mul(above, square) + vec16(9.999999568e-01)
    below = wp.cw_mul(vec16(8.224647886e-07), square) + vec16(3.361201655e-04)
    below = wp.cw_mul(below, square) + vec16(2.604963071e-02)
    below = wp.cw_mul(below, square) + vec16(4.675244459e-01)
    below = wp.cw_mul(below, square) + vec16(1.0)
    return wp.cw_div(wp.cw_mul(y, above), below) * 0.5 + vec16(0.5)


@wp.kernel
def process_kernel(
    bearings: wp.array2d[wp.vec3],
    numbers: wp.array2d[vec16],
    planes: wp.array2d[vec16],
    at_once: wp.int32,
    sums: wp.array4d[vec16],
):
    """Sums, over a part of the landmarks, of the numbers times the soft steps of sixteen axes.

    The rows of `planes` are x, y and z of sixteen axes and minus the cosine of the edge, all times half the steepness.
    """
    location, part, axes = wp.tid()
    zx = planes[axes, 0]
    zy = planes[axes, 1]
    zz = planes[axes, 2]
    edge = planes[axes, 3]
    total = mat15x16()
    for landmark in range(part * at_once, wp.min((part + 1) * at_once, bearings.shape[1])):
        f = bearings[location, landmark]
        n = numbers[location, landmark]
        seen = soft_step(zx * f[0] + zy * f[1] + zz * f[2] + edge)
        for i in range(15):
            total[i] += seen * n[i]
    for i in range(15):
        sums[location, part, axes, i] = total[i]
