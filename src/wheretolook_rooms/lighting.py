"""Baked light: daylight through the windows, lamps, and light reflected by walls and furniture.

Light is computed on a coarse grid per patch by ray casting: shadow rays to points on each window and around each lamp,
then rays over the hemisphere that read the direct light where they end (one bounce; a constant factor accounts for the
later ones). Random numbers come from a hash of the sample's index, one thread writes one sample, and nothing is
accumulated atomically, so the same scene always gives the same light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import warp as wp
from numpy.typing import NDArray

from wheretolook.utils.warp import start_warp, vec3_array
from wheretolook_rooms.layout import Lamp
from wheretolook_rooms.light_kernels import direct_kernel, gather_kernel
from wheretolook_rooms.patches import Patch, Surface

Float = NDArray[np.floating[Any]]

SKY = (5.2, 5.7, 6.3)  # radiance of a window pane per colour; lamps are in the same unit
AMBIENT = (0.018, 0.019, 0.02)
LATER_BOUNCES = 1.7  # light of all bounces together, relative to that of the first
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # weights of linear red, green and blue (ITU-R BT.709)
_BINOMIAL = np.array([0.25, 0.5, 0.25], np.float32)


@dataclass(frozen=True, eq=False)
class Samples:
    """Points where light is computed."""

    points: Float  # (S, 3) metres
    normals: Float  # (S, 3)
    room: NDArray[np.int32]  # (S,) index
    start: NDArray[np.int32]  # (P,) first sample of each patch
    shape: NDArray[np.int32]  # (P, 2) rows and columns of each patch's grid


def place_samples(patches: Sequence[Patch], spacing_m: float) -> Samples:
    """A grid of samples on every patch that does not glow, about `spacing_m` apart, at the middles of its cells."""
    points = []
    normals = []
    shapes = []
    for patch in patches:
        if patch.material.emissive:
            ny = nx = 0
        elif patch.material.shared:
            ny = nx = 1
        else:
            coarse = spacing_m if patch.density > 0.3 else 4 * spacing_m
            nx, ny = (max(1, round(extent / coarse)) for extent in patch.size_m)
        shapes.append((ny, nx))
        if nx:
            p, n = _evaluate(patch, (np.arange(nx) + 0.5) / nx, (np.arange(ny) + 0.5) / ny)
            points.append(p.reshape(-1, 3))
            normals.append(n.reshape(-1, 3))
    shape = np.array(shapes, np.int32)
    counts = shape.prod(1)
    room = np.repeat(np.array([patch.room for patch in patches], np.int32), counts)
    start = (np.cumsum(counts) - counts).astype(np.int32)
    return Samples(np.concatenate(points), np.concatenate(normals), room, start, shape)


def _evaluate(patch: Patch, s: Float, t: Float) -> tuple[Float, Float]:
    """Points and unit normals (len(t), len(s), 3) of a patch, bilinear within each of its cells."""
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


@dataclass(frozen=True, eq=False)
class Light:
    """Linear light per sample."""

    sharp: Float  # (S, 3) from the room's own windows and lamps
    soft: Float  # (S, 3) reflected by surfaces, or come through doors and past curtains
    valid: NDArray[np.bool_]  # (S,) False for samples inside a solid

    @property
    def luminance(self) -> Float:
        """Brightness of the valid samples."""
        return (self.sharp + self.soft)[self.valid] @ LUMINANCE


def bake(
    patches: Sequence[Patch],
    surface: Surface,
    samples: Samples,
    albedo: Float,
    windows: Sequence[tuple[Patch, bool]],
    lamps: Sequence[Lamp],
    *,
    device: str,
    rays: int,
) -> Light:
    """The light at all samples, of windows (flat patches, and whether a curtain is drawn before them) and of lit lamps.

    `surface` are the triangles of all patches; materials that cast no shadow are left out. `albedo` (P, 3) is linear,
    the mean of each patch. `rays` go over the hemisphere of a sample; each window and lamp gets a fraction of them.
    """
    device = start_warp(device)
    kept = np.flatnonzero(np.array([p.material.casts_shadow for p in patches])[surface.patch])
    panes = [pane for pane, _ in windows]

    def vectors(values: object) -> Any:
        return vec3_array(np.array(values, np.float32).reshape(-1, 3), device)

    def integers(values: object) -> Any:
        return wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.int32, device=device)

    mesh = wp.Mesh(points=vectors(surface.vertices), indices=integers(surface.triangles[kept].ravel()))
    places = [mesh.id, vectors(samples.points), vectors(samples.normals)]
    count = len(samples.points)
    direct, soft, bounced = (wp.empty(count, dtype=wp.vec3, device=device) for _ in range(3))
    open_share, back_share = (wp.empty(count, dtype=wp.float32, device=device) for _ in range(2))
    corners, rights, downs = (np.array([p.positions[at] for p in panes]) for at in ((0, 0), (0, -1), (-1, 0)))
    window_inputs = [vectors(corners), vectors(rights - corners), vectors(downs - corners)]
    window_inputs += [integers([p.room for p in panes]), integers([covered for _, covered in windows])]
    lamp_inputs = [vectors([lamp.position for lamp in lamps]), vectors([lamp.colour for lamp in lamps])]
    lamp_inputs += [integers([lamp.room for lamp in lamps]), max(2, rays // 6)]
    inputs = [*places, integers(samples.room), *window_inputs, max(4, rays // 2), wp.vec3(*SKY), *lamp_inputs]
    wp.launch(direct_kernel, count, inputs, [direct, soft], device=device)
    st: Any = wp.array(np.ascontiguousarray(surface.st[kept], np.float32), dtype=wp.vec2, device=device)
    shape: Any = wp.array(samples.shape, dtype=wp.vec2i, device=device)
    triangle_patch = integers(surface.patch[kept])
    inputs = [*places, rays, triangle_patch, st, integers(samples.start), shape, vectors(albedo), direct]
    wp.launch(gather_kernel, count, inputs, [bounced, open_share, back_share], device=device)
    through_doors = soft.numpy()
    ambient = np.array(AMBIENT, np.float32) * open_share.numpy()[:, None]
    reflected = through_doors + LATER_BOUNCES * bounced.numpy() + ambient
    return Light(direct.numpy() - through_doors, reflected, back_share.numpy() < 0.4)


def light_grids(samples: Samples, light: Light) -> list[Float | None]:
    """Light per patch as (rows, columns, 3), smoothed, with samples inside solids filled from their neighbours."""
    grids: list[Float | None] = []
    for first, (ny, nx) in zip(samples.start, samples.shape, strict=True):
        rows = slice(first, first + nx * ny)
        sharp, soft = (values[rows].reshape(ny, nx, 3) for values in (light.sharp, light.soft))
        valid = light.valid[rows].reshape(ny, nx, 1)
        if nx * ny > 1 and valid.any():
            # Light from all around varies slowly, so it is smoothed more.
            sharp = _smooth(sharp, valid, 1)
            soft = _smooth(soft, valid, 4)
        grids.append(sharp + soft if nx else None)
    return grids


def _smooth(grid: Float, valid: NDArray[np.bool_], passes: int) -> Float:
    """Binomial blur over the valid samples, extended over the others."""
    weight = valid.astype(np.float32)
    data = np.concatenate([grid * weight, weight], -1).astype(np.float32)
    for k in range(passes + 12):
        if k >= passes and (data[..., 3] > 1e-3).all():
            break
        blurred = cv2.sepFilter2D(data, -1, _BINOMIAL, _BINOMIAL, borderType=cv2.BORDER_REPLICATE)
        wider = np.asarray(blurred, np.float32).reshape(data.shape)
        # After the requested passes, only samples without a value change.
        data = wider if k < passes else np.where(data[..., 3:] > 1e-3, data, wider)
    return np.asarray(np.where(data[..., 3:] > 1e-3, data[..., :3] / np.maximum(data[..., 3:], 1e-6), grid))


def to_display(light: Float, reference: float) -> Float:
    """Factor on display-space albedo: gamma, compressed as an eye or camera would, with a soft shoulder.

    Albedo and light are multiplied in linear space. Powers of them can be multiplied as well, so light can be converted
    on its coarse grid.
    """
    luminance = np.maximum(light @ LUMINANCE, 1e-5)[..., None]
    tone = 0.8 * (luminance / reference) ** (0.85 / 2.2)
    tone = tone / (1 + (tone / 1.06) ** 5) ** (1 / 5)
    return np.asarray(tone * np.clip(light / luminance, 0.05, 4) ** (0.6 / 2.2))
