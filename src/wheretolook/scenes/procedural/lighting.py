"""Baked light: daylight through the windows, lamps, and what walls and furniture throw back.

Light is computed on a coarse grid per patch by ray casting: shadow rays to points on each window and around each lamp,
then one gather over the hemisphere that reads the direct light where its rays end (one bounce; a constant stands for
the later ones). Random numbers come from a hash of the sample's index, one thread writes one sample, and nothing is
accumulated atomically, so the same scene gives the same light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import warp as wp
from numpy.typing import NDArray

from wheretolook.scenes.procedural.patches import Patch

wp.config.quiet = True

Float = NDArray[np.floating[Any]]


@dataclass(frozen=True, eq=False)
class Samples:
    """Where light is computed.

    Attributes:
        points: (S, 3) metres.
        normals: (S, 3).
        room: (S,) index.
        start: (P,) first sample of each patch.
        shape: (P, 2) rows and columns of each patch's grid.
    """

    points: Float
    normals: Float
    room: NDArray[np.int32]
    start: NDArray[np.int32]
    shape: NDArray[np.int32]


def place_samples(patches: Sequence[Patch], spacing_m: float) -> Samples:
    """A grid of samples on every patch, about `spacing_m` apart, at the middles of its cells."""
    points, normals, rooms, starts, shapes, total = [], [], [], [], [], 0
    for patch in patches:
        if patch.material.emissive:
            ny = nx = 0
        elif patch.material.shared:
            ny = nx = 1
        else:
            coarse = spacing_m if patch.density > 0.3 else 4 * spacing_m
            nx, ny = (max(1, round(extent / coarse)) for extent in patch.size_m)
        starts.append(total)
        shapes.append((ny, nx))
        if nx:
            p, n = _evaluate(patch, (np.arange(nx) + 0.5) / nx, (np.arange(ny) + 0.5) / ny)
            points.append(p.reshape(-1, 3))
            normals.append(n.reshape(-1, 3))
            rooms.append(np.full(nx * ny, patch.room, np.int32))
            total += nx * ny
    return Samples(np.concatenate(points), np.concatenate(normals), np.concatenate(rooms), np.array(starts, np.int32), np.array(shapes, np.int32))


def _evaluate(patch: Patch, s: Float, t: Float) -> tuple[Float, Float]:
    """Points and unit normals (len(t), len(s), 3) of the bilinear surface."""
    i = np.clip(np.searchsorted(patch.s, s, side="right") - 1, 0, len(patch.s) - 2)
    j = np.clip(np.searchsorted(patch.t, t, side="right") - 1, 0, len(patch.t) - 2)
    a = ((s - patch.s[i]) / (patch.s[i + 1] - patch.s[i]))[None, :, None]
    b = ((t - patch.t[j]) / (patch.t[j + 1] - patch.t[j]))[:, None, None]
    p = patch.positions
    tl, tr, bl, br = (p[np.ix_(j + dj, i + di)] for dj, di in ((0, 0), (0, 1), (1, 0), (1, 1)))
    point = (1 - b) * ((1 - a) * tl + a * tr) + b * ((1 - a) * bl + a * br)
    right = (1 - b) * (tr - tl) + b * (br - bl)
    down = (1 - a) * (bl - tl) + a * (br - tr)
    normal = np.cross(down, right)
    return point, normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)


_R2_U, _R2_V = wp.constant(wp.uint32(3242174889)), wp.constant(wp.uint32(2447445414))


@wp.func
def _r2(index: int) -> wp.vec2:
    """Point of Roberts' R2 sequence, in whole numbers so that it stays exact; neighbouring samples take neighbouring
    stretches of it, so that smoothing over them smooths away most of the noise."""
    k = wp.uint32(index)
    return wp.vec2(float(k * _R2_U) / 4294967296.0, float(k * _R2_V) / 4294967296.0)


@wp.kernel
def _direct(
    mesh: wp.uint64, points: wp.array(dtype=wp.vec3), normals: wp.array(dtype=wp.vec3), room: wp.array(dtype=int),
    window_corner: wp.array(dtype=wp.vec3), window_right: wp.array(dtype=wp.vec3), window_down: wp.array(dtype=wp.vec3),
    window_room: wp.array(dtype=int), window_soft: wp.array(dtype=int), window_rays: int, sky: wp.vec3,
    lamp_position: wp.array(dtype=wp.vec3), lamp_colour: wp.array(dtype=wp.vec3), lamp_room: wp.array(dtype=int), lamp_rays: int,
    light: wp.array(dtype=wp.vec3), soft: wp.array(dtype=wp.vec3),
):  # fmt: skip
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
    for l in range(lamp_position.shape[0]):
        rays = int(lamp_rays)
        if lamp_room[l] != room[k]:
            rays = 2
        share = float(0.0)
        for r in range(rays):
            q = lamp_position[l] + 0.07 * wp.sample_unit_sphere(state)
            d = q - p
            distance = wp.length(d)
            d = d / wp.max(distance, 1.0e-6)
            cosine = wp.dot(d, n)
            if cosine > 0.0:
                if not wp.mesh_query_ray_anyhit(mesh, p, d, distance):
                    share += cosine / wp.max(distance * distance, 0.04)
        total += lamp_colour[l] * (share / float(rays))
        if lamp_room[l] != room[k]:
            filtered += lamp_colour[l] * (share / float(rays))
    light[k] = total
    soft[k] = filtered


@wp.kernel
def _gather(
    mesh: wp.uint64, points: wp.array(dtype=wp.vec3), normals: wp.array(dtype=wp.vec3), rays: int,
    triangle_patch: wp.array(dtype=int), triangle_st: wp.array(dtype=wp.vec2, ndim=2), start: wp.array(dtype=int), shape: wp.array(dtype=wp.vec2i),
    albedo: wp.array(dtype=wp.vec3), direct: wp.array(dtype=wp.vec3), bounced: wp.array(dtype=wp.vec3), open_share: wp.array(dtype=float),
    back_share: wp.array(dtype=float),
):  # fmt: skip
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
                    st = hit.u * triangle_st[hit.face, 0] + hit.v * triangle_st[hit.face, 1] + (1.0 - hit.u - hit.v) * triangle_st[hit.face, 2]
                    column = wp.clamp(int(st[0] * float(size[1])), 0, size[1] - 1)
                    row = wp.clamp(int(st[1] * float(size[0])), 0, size[0] - 1)
                    total += wp.cw_mul(albedo[which], direct[start[which] + row * size[1] + column])
    bounced[k] = total / float(rays)
    open_share[k] = clear / float(rays)
    back_share[k] = backs / float(rays)


def bake(
    patches: Sequence[Patch], samples: Samples, vertices: Float, triangles: NDArray[np.int64], triangle_patch: NDArray[np.int64],
    triangle_st: Float, albedo: Float, windows: Sequence[Patch], covered: NDArray[np.bool_], lamps: Float, lamp_room: NDArray[np.int32], *, device: str, rays: int,
) -> tuple[Float, Float, NDArray[np.bool_]]:  # fmt: skip
    """Linear light per sample.

    Args:
        patches: all patches of the scene.
        samples: where to compute it.
        vertices: (V, 3) metres.
        triangles: (T, 3) vertex indices; only those that cast shadows are used.
        triangle_patch: (T,) patch of each triangle.
        triangle_st: (T, 3, 2) patch coordinates of the corners.
        albedo: (P, 3) mean linear albedo of each patch.
        windows: patches that let daylight in; flat.
        covered: (W,) whether a curtain is drawn before the window.
        lamps: (L, 6) position and strength per colour.
        lamp_room: (L,) room of each lamp.
        device: Warp device, such as `cpu` or `cuda:0`.
        rays: gather rays per sample; windows and lamps take a fraction of it.

    Returns:
        Light with sharp shadows (S, 3), from the room's own windows and lamps; light without (S, 3), thrown back or come
        through doors and past curtains; and whether the sample lies in the open rather than inside something (S,).
    """
    casts = np.array([p.material.casts_shadow for p in patches])[triangle_patch]
    kept = np.flatnonzero(casts)
    with wp.ScopedDevice(device):
        mesh = wp.Mesh(
            points=wp.array(vertices.astype(np.float32), dtype=wp.vec3), indices=wp.array(triangles[kept].astype(np.int32).ravel(), dtype=int)
        )
        points, normals = (wp.array(a.astype(np.float32), dtype=wp.vec3) for a in (samples.points, samples.normals))
        corner = np.array([w.positions[0, 0] for w in windows], np.float32).reshape(-1, 3)
        right = np.array([w.positions[0, -1] - w.positions[0, 0] for w in windows], np.float32).reshape(-1, 3)
        down = np.array([w.positions[-1, 0] - w.positions[0, 0] for w in windows], np.float32).reshape(-1, 3)
        count = len(samples.points)
        direct, soft, bounced = (wp.empty(count, dtype=wp.vec3) for _ in range(3))
        clear, back = wp.empty(count, dtype=float), wp.empty(count, dtype=float)
        wp.launch(_direct, dim=count, inputs=[
            mesh.id, points, normals, wp.array(samples.room, dtype=int),
            wp.array(corner, dtype=wp.vec3), wp.array(right, dtype=wp.vec3), wp.array(down, dtype=wp.vec3),
            wp.array(np.array([w.room for w in windows], np.int32), dtype=int), wp.array(covered.astype(np.int32), dtype=int), max(4, rays // 2), wp.vec3(5.2, 5.7, 6.3),
            wp.array(np.ascontiguousarray(lamps[:, :3], np.float32), dtype=wp.vec3), wp.array(np.ascontiguousarray(lamps[:, 3:], np.float32), dtype=wp.vec3),
            wp.array(lamp_room, dtype=int), max(2, rays // 6), direct, soft,
        ])  # fmt: skip
        wp.launch(_gather, dim=count, inputs=[
            mesh.id, points, normals, rays, wp.array(triangle_patch[kept].astype(np.int32), dtype=int),
            wp.array(triangle_st[kept].astype(np.float32), dtype=wp.vec2), wp.array(samples.start, dtype=int), wp.array(samples.shape, dtype=wp.vec2i),
            wp.array(albedo.astype(np.float32), dtype=wp.vec3), direct, bounced, clear, back,
        ])  # fmt: skip
        e0, far, e1, opened, backs = (a.numpy() for a in (direct, soft, bounced, clear, back))
    later_bounces = 1.7
    ambient = np.array([0.011, 0.012, 0.013], np.float32)
    return e0 - far, far + later_bounces * e1 + ambient * opened[:, None], backs < 0.4


def light_grids(samples: Samples, direct: Float, indirect: Float, valid: NDArray[np.bool_]) -> list[Float | None]:
    """Light per patch as (rows, columns, 3), smoothed, with samples inside solids filled from their neighbours."""
    grids: list[Float | None] = []
    for first, (ny, nx) in zip(samples.start, samples.shape, strict=True):
        last = first + nx * ny
        if nx == 0:
            grids.append(None)
        elif nx * ny == 1 or not valid[first:last].any():
            grids.append((direct[first:last] + indirect[first:last]).reshape(ny, nx, 3))
        else:
            weight = valid[first:last].reshape(ny, nx, 1).astype(np.float32)
            # what comes from all around varies slowly: smooth it more
            sharp = _smooth(direct[first:last].reshape(ny, nx, 3), weight, 1)
            grids.append(sharp + _smooth(indirect[first:last].reshape(ny, nx, 3), weight, 4))
    return grids


def _smooth(grid: Float, weight: Float, passes: int) -> Float:
    """Binomial blur over the samples with weight 1, extended over those with weight 0."""
    data = np.concatenate([grid * weight, weight], -1).astype(np.float32)
    for k in range(passes + 12):
        if k >= passes and (data[..., 3] > 1e-3).all():
            break
        wider = _blur(data)
        # past the passes asked for, only samples that still have no value take one
        data = wider if k < passes else np.where(data[..., 3:] > 1e-3, data, wider)
    return np.where(data[..., 3:] > 1e-3, data[..., :3] / np.maximum(data[..., 3:], 1e-6), grid)


def _blur(image: Float) -> Float:
    return np.asarray(cv2.sepFilter2D(image, -1, _BINOMIAL, _BINOMIAL, borderType=cv2.BORDER_REPLICATE)).reshape(image.shape)


_BINOMIAL = np.array([0.25, 0.5, 0.25], np.float32)


def to_display(light: Float, reference: float) -> Float:
    """Factor on display-space albedo: gamma, compressed as an eye or camera would, with a soft shoulder.

    Albedo and light multiply in linear space; with a pure power law they also multiply after it, so light can be mapped
    on its coarse grid.
    """
    luminance = np.maximum(light @ np.array([0.2126, 0.7152, 0.0722]), 1e-5)[..., None]
    tone = 0.8 * (luminance / reference) ** (0.85 / 2.2)
    tone = tone / (1 + (tone / 1.06) ** 5) ** (1 / 5)
    return tone * np.clip(light / luminance, 0.05, 4) ** (0.6 / 2.2)
