"""Warp kernels that add up a Fisher Information Field.

On a CPU a thread does sixteen numbers by one instruction: vectors are as long as its registers (AVX-512), and multiply
and add are fused.
"""

# mypy: ignore-errors
# Warp's kernel language is not Python's type system.

from __future__ import annotations

import warp as wp

from wheretolook.visibility.frustum_kernel import offset_from

wp.set_module_options(
    {
        "enable_backward": False,
        "cpu_compiler_flags": "-march=native -mprefer-vector-width=512 -ffp-contract=fast",
    }
)

vec16 = wp.types.vector(length=16, dtype=wp.float32)


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
    """The 15 numbers of every landmark at every location; zero if it is hidden or too near."""
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
    """Sums over a part of the landmarks of numbers times xx, xy, xz, yy, yz, zz, x, y, z, one."""
    location, part = wp.tid()
    xx = vec16()
    xy = vec16()
    xz = vec16()
    yy = vec16()
    yz = vec16()
    zz = vec16()
    x = vec16()
    y = vec16()
    z = vec16()
    one = vec16()
    for landmark in range(part * at_once, wp.min((part + 1) * at_once, bearings.shape[1])):
        f = bearings[location, landmark]
        n = numbers[location, landmark]
        xx += n * (f[0] * f[0])
        xy += n * (f[0] * f[1])
        xz += n * (f[0] * f[2])
        yy += n * (f[1] * f[1])
        yz += n * (f[1] * f[2])
        zz += n * (f[2] * f[2])
        x += n * f[0]
        y += n * f[1]
        z += n * f[2]
        one += n
    sums[location, part, 0] = xx
    sums[location, part, 1] = xy
    sums[location, part, 2] = xz
    sums[location, part, 3] = yy
    sums[location, part, 4] = yz
    sums[location, part, 5] = zz
    sums[location, part, 6] = x
    sums[location, part, 7] = y
    sums[location, part, 8] = z
    sums[location, part, 9] = one


@wp.func
def soft_step(x: vec16) -> vec16:
    """1 / (1 + exp(-2 x)) = (1 + tanh x) / 2 to some 1e-7, by the tangent's best rational approximation of this degree.

    Found by Lawson's iteration on [0, 8.3], where it errs by 8e-9; beyond, the tangent is 1 but for 1.3e-7.
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
    """Sums over a part of the landmarks of numbers times the soft steps of sixteen axes.

    The rows of `planes` are x, y, z of sixteen axes and minus the cosine of the edge, times half the steepness.
    """
    location, part, axes = wp.tid()
    zx = planes[axes, 0]
    zy = planes[axes, 1]
    zz = planes[axes, 2]
    edge = planes[axes, 3]
    s0 = vec16()
    s1 = vec16()
    s2 = vec16()
    s3 = vec16()
    s4 = vec16()
    s5 = vec16()
    s6 = vec16()
    s7 = vec16()
    s8 = vec16()
    s9 = vec16()
    s10 = vec16()
    s11 = vec16()
    s12 = vec16()
    s13 = vec16()
    s14 = vec16()
    for landmark in range(part * at_once, wp.min((part + 1) * at_once, bearings.shape[1])):
        f = bearings[location, landmark]
        n = numbers[location, landmark]
        seen = soft_step(zx * f[0] + zy * f[1] + zz * f[2] + edge)
        s0 += seen * n[0]
        s1 += seen * n[1]
        s2 += seen * n[2]
        s3 += seen * n[3]
        s4 += seen * n[4]
        s5 += seen * n[5]
        s6 += seen * n[6]
        s7 += seen * n[7]
        s8 += seen * n[8]
        s9 += seen * n[9]
        s10 += seen * n[10]
        s11 += seen * n[11]
        s12 += seen * n[12]
        s13 += seen * n[13]
        s14 += seen * n[14]
    sums[location, part, axes, 0] = s0
    sums[location, part, axes, 1] = s1
    sums[location, part, axes, 2] = s2
    sums[location, part, axes, 3] = s3
    sums[location, part, axes, 4] = s4
    sums[location, part, axes, 5] = s5
    sums[location, part, axes, 6] = s6
    sums[location, part, axes, 7] = s7
    sums[location, part, axes, 8] = s8
    sums[location, part, axes, 9] = s9
    sums[location, part, axes, 10] = s10
    sums[location, part, axes, 11] = s11
    sums[location, part, axes, 12] = s12
    sums[location, part, axes, 13] = s13
    sums[location, part, axes, 14] = s14
