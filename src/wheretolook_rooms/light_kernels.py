"""Warp kernels of the baked light; one source for CUDA and the CPU."""

# mypy: ignore-errors
# The arguments of Warp kernels are annotated with values that a type checker cannot read.
# ruff: noqa: B007, SIM102, UP018
# Warp needs float(0.0) for a variable that a loop changes, and does not skip the second operand of `and`.

import warp as wp

wp.set_module_options({"enable_backward": False})

_R2_U = wp.constant(wp.uint32(3242174889))
_R2_V = wp.constant(wp.uint32(2447445414))


@wp.func
def _r2(index: int) -> wp.vec2:
    """Point of Roberts' R2 sequence, in integers so that it is exact.

    Neighbouring samples take neighbouring parts of the sequence, so that smoothing over them removes most noise.
    """
    k = wp.uint32(index)
    return wp.vec2(float(k * _R2_U) / 4294967296.0, float(k * _R2_V) / 4294967296.0)


@wp.kernel
def direct_kernel(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    room: wp.array(dtype=int),
    window_corner: wp.array(dtype=wp.vec3),
    window_right: wp.array(dtype=wp.vec3),
    window_down: wp.array(dtype=wp.vec3),
    window_room: wp.array(dtype=int),
    window_soft: wp.array(dtype=int),
    window_rays: int,
    sky: wp.vec3,
    lamp_position: wp.array(dtype=wp.vec3),
    lamp_colour: wp.array(dtype=wp.vec3),
    lamp_room: wp.array(dtype=int),
    lamp_rays: int,
    light: wp.array(dtype=wp.vec3),
    soft: wp.array(dtype=wp.vec3),
):
    """Light of windows and lamps at each sample; `soft` is the part that comes through doors and past curtains."""
    k = wp.tid()
    n = normals[k]
    p = points[k] + 0.004 * n
    state = wp.rand_init(7919, k)
    total = wp.vec3(0.0, 0.0, 0.0)
    filtered = wp.vec3(0.0, 0.0, 0.0)
    for w in range(window_corner.shape[0]):
        across = window_right[w]
        down = window_down[w]
        facing = wp.normalize(wp.cross(down, across))
        area = wp.length(wp.cross(down, across))
        rays = int(window_rays)
        if window_room[w] != room[k]:
            rays = 6
        if wp.dot(window_corner[w] + 0.5 * across + 0.5 * down - p, facing) < 0.3 * wp.length(across):
            share = float(0.0)
            for r in range(rays):
                uv = _r2(k * rays + r)
                q = window_corner[w] + uv[0] * across + uv[1] * down + 0.06 * facing
                d = q - p
                distance = wp.length(d)
                d = d / wp.max(distance, 1.0e-6)
                cosines = wp.max(wp.dot(d, n), 0.0) * wp.max(-wp.dot(d, facing), 0.0)
                if cosines > 0.0:
                    if not wp.mesh_query_ray_anyhit(mesh, p, d, distance - 0.002):
                        share += cosines / wp.max(distance * distance, 0.02)
            arriving = sky * (share * area / float(rays) / 3.14159265)
            total += arriving
            if window_room[w] != room[k] or window_soft[w] != 0:
                filtered += arriving
    for i in range(lamp_position.shape[0]):
        rays = int(lamp_rays)
        if lamp_room[i] != room[k]:
            rays = 2
        share = float(0.0)
        for r in range(rays):
            q = lamp_position[i] + 0.07 * wp.sample_unit_sphere(state)
            d = q - p
            distance = wp.length(d)
            d = d / wp.max(distance, 1.0e-6)
            cosine = wp.dot(d, n)
            if cosine > 0.0:
                if not wp.mesh_query_ray_anyhit(mesh, p, d, distance):
                    share += cosine / wp.max(distance * distance, 0.04)
        total += lamp_colour[i] * (share / float(rays))
        if lamp_room[i] != room[k]:
            filtered += lamp_colour[i] * (share / float(rays))
    light[k] = total
    soft[k] = filtered


@wp.kernel
def gather_kernel(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    rays: int,
    triangle_patch: wp.array(dtype=int),
    triangle_st: wp.array(dtype=wp.vec2, ndim=2),
    start: wp.array(dtype=int),
    shape: wp.array(dtype=wp.vec2i),
    albedo: wp.array(dtype=wp.vec3),
    direct: wp.array(dtype=wp.vec3),
    bounced: wp.array(dtype=wp.vec3),
    open_share: wp.array(dtype=float),
    back_share: wp.array(dtype=float),
):
    """Light reflected to each sample by the surfaces around it.

    `open_share` is the mean distance of the surroundings, 0 to 1 at 0.6 m; `back_share` is the share of rays that hit
    the back of a triangle, as they do inside solids.
    """
    k = wp.tid()
    n = normals[k]
    p = points[k] + 0.004 * n
    helper = wp.vec3(1.0, 0.0, 0.0)
    if wp.abs(n[0]) > 0.7:
        helper = wp.vec3(0.0, 1.0, 0.0)
    a = wp.normalize(wp.cross(n, helper))
    b = wp.cross(n, a)
    total = wp.vec3(0.0, 0.0, 0.0)
    clear = float(0.0)
    backs = float(0.0)
    for r in range(rays):
        uv = _r2(k * rays + r)
        u = uv[0]
        radius = wp.sqrt(u)
        angle = 6.2831853 * uv[1]
        d = radius * wp.cos(angle) * a + radius * wp.sin(angle) * b + wp.sqrt(1.0 - u) * n
        hit = wp.mesh_query_ray(mesh, p, d, 30.0)
        if hit.result:
            if hit.sign < 0.0:
                backs += 1.0
            else:
                clear += wp.min(hit.t / 0.6, 1.0)
                which = triangle_patch[hit.face]
                size = shape[which]
                if size[0] > 0:
                    st = hit.u * triangle_st[hit.face, 0] + hit.v * triangle_st[hit.face, 1]
                    st += (1.0 - hit.u - hit.v) * triangle_st[hit.face, 2]
                    column = wp.clamp(int(st[0] * float(size[1])), 0, size[1] - 1)
                    row = wp.clamp(int(st[1] * float(size[0])), 0, size[0] - 1)
                    total += wp.cw_mul(albedo[which], direct[start[which] + row * size[1] + column])
    bounced[k] = total / float(rays)
    open_share[k] = clear / float(rays)
    back_share[k] = backs / float(rays)
