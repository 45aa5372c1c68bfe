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

from wheretolook.scenes.procedural.layout import Lamp
from wheretolook.scenes.procedural.light_kernels import direct_kernel, gather_kernel
from wheretolook.scenes.procedural.patches import Patch, Surface
from wheretolook.utils.warp import start_warp, vec3_array

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
    return Samples(
        np.concatenate(points),
        np.concatenate(normals),
        np.concatenate(rooms),
        np.array(starts, np.int32),
        np.array(shapes, np.int32),
    )


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


SKY = (5.2, 5.7, 6.3)
"""Radiance of a window pane per colour; lamps are in the same unit."""
AMBIENT = (0.018, 0.019, 0.02)
LATER_BOUNCES = 1.7
"""All bounces together, relative to the first."""


@dataclass(frozen=True, eq=False)
class Light:
    """Linear light per sample.

    Attributes:
        sharp: (S, 3) from the room's own windows and lamps.
        soft: (S, 3) thrown back by surfaces, or come through doors and past curtains.
        valid: (S,) whether the sample lies in the open rather than inside something.
    """

    sharp: Float
    soft: Float
    valid: NDArray[np.bool_]

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
    """Cast the rays.

    Args:
        patches: all patches of the scene.
        surface: their triangles; those of materials that cast no shadow are left out.
        samples: where light is computed.
        albedo: (P, 3) mean linear albedo of each patch.
        windows: flat patches that let daylight in, and whether a curtain is drawn before them.
        lamps: the lamps that are lit.
        device: Warp device, such as "cpu" or "cuda".
        rays: gather rays per sample; windows and lamps take a fraction of it each.
    """
    device = start_warp(device)
    kept = np.flatnonzero(np.array([p.material.casts_shadow for p in patches])[surface.patch])
    panes = [pane for pane, _ in windows]

    def vectors(values: object) -> Any:
        return vec3_array(np.array(values, np.float32).reshape(-1, 3), device)

    def integers(values: object) -> Any:
        return wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.int32, device=device)

    mesh = wp.Mesh(points=vectors(surface.vertices), indices=integers(surface.triangles[kept].ravel()))
    points, normals = vectors(samples.points), vectors(samples.normals)
    count = len(samples.points)
    direct, soft, bounced = (wp.empty(count, dtype=wp.vec3, device=device) for _ in range(3))
    open_share, back_share = (wp.empty(count, dtype=wp.float32, device=device) for _ in range(2))
    wp.launch(
        direct_kernel,
        dim=count,
        inputs=[
            mesh.id,
            points,
            normals,
            integers(samples.room),
            vectors([p.positions[0, 0] for p in panes]),
            vectors([p.positions[0, -1] - p.positions[0, 0] for p in panes]),
            vectors([p.positions[-1, 0] - p.positions[0, 0] for p in panes]),
            integers([p.room for p in panes]),
            integers([covered for _, covered in windows]),
            max(4, rays // 2),
            wp.vec3(*SKY),
            vectors([lamp.position for lamp in lamps]),
            vectors([lamp.colour for lamp in lamps]),
            integers([lamp.room for lamp in lamps]),
            max(2, rays // 6),
        ],
        outputs=[direct, soft],
        device=device,
    )
    wp.launch(
        gather_kernel,
        dim=count,
        inputs=[
            mesh.id,
            points,
            normals,
            rays,
            integers(surface.patch[kept]),
            wp.array(np.ascontiguousarray(surface.st[kept], np.float32), dtype=wp.vec2, device=device),
            integers(samples.start),
            wp.array(samples.shape, dtype=wp.vec2i, device=device),
            vectors(albedo),
            direct,
        ],
        outputs=[bounced, open_share, back_share],
        device=device,
    )
    through_doors = soft.numpy()
    ambient = np.array(AMBIENT, np.float32) * open_share.numpy()[:, None]
    return Light(
        sharp=direct.numpy() - through_doors,
        soft=through_doors + LATER_BOUNCES * bounced.numpy() + ambient,
        valid=back_share.numpy() < 0.4,
    )


LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def light_grids(samples: Samples, light: Light) -> list[Float | None]:
    """Light per patch as (rows, columns, 3), smoothed, with samples inside solids filled from their neighbours."""
    grids: list[Float | None] = []
    for first, (ny, nx) in zip(samples.start, samples.shape, strict=True):
        last = first + nx * ny
        if nx == 0:
            grids.append(None)
        elif nx * ny == 1 or not light.valid[first:last].any():
            grids.append((light.sharp[first:last] + light.soft[first:last]).reshape(ny, nx, 3))
        else:
            weight = light.valid[first:last].reshape(ny, nx, 1).astype(np.float32)
            # what comes from all around varies slowly: smooth it more
            sharp = _smooth(light.sharp[first:last].reshape(ny, nx, 3), weight, 1)
            grids.append(sharp + _smooth(light.soft[first:last].reshape(ny, nx, 3), weight, 4))
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
    return np.asarray(np.where(data[..., 3:] > 1e-3, data[..., :3] / np.maximum(data[..., 3:], 1e-6), grid))


def _blur(image: Float) -> Float:
    blurred = cv2.sepFilter2D(image, -1, _BINOMIAL, _BINOMIAL, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, np.float32).reshape(image.shape)


_BINOMIAL = np.array([0.25, 0.5, 0.25], np.float32)


def to_display(light: Float, reference: float) -> Float:
    """Factor on display-space albedo: gamma, compressed as an eye or camera would, with a soft shoulder.

    Albedo and light multiply in linear space; with a pure power law they also multiply after it, so light can be mapped
    on its coarse grid.
    """
    luminance = np.maximum(light @ LUMINANCE, 1e-5)[..., None]
    tone = 0.8 * (luminance / reference) ** (0.85 / 2.2)
    tone = tone / (1 + (tone / 1.06) ** 5) ** (1 / 5)
    return np.asarray(tone * np.clip(light / luminance, 0.05, 4) ** (0.6 / 2.2))
