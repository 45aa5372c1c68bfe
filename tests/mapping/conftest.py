"""A small textured room whose free space is known in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from wheretolook.geometry.mesh import TexturedMesh

ROOM_SIZE = (5.0, 4.0, 2.6)


@dataclass(frozen=True)
class BoxFreeSpace:
    """Free space of an empty box, less `clearance_m`, less a solid column (2D rectangle) that reaches the ceiling."""

    size: tuple[float, float, float] = ROOM_SIZE
    clearance_m: float = 0.25
    column: tuple[tuple[float, float], tuple[float, float]] | None = None

    def is_free(self, points):
        points = np.asarray(points)
        free = ((points > self.clearance_m) & (points < np.array(self.size) - self.clearance_m)).all(1)
        if self.column is not None:
            low, high = np.array(self.column)
            free &= ((points[:, :2] < low) | (points[:, :2] > high)).any(1)
        return free

    def segments_are_free(self, a, b):
        steps = np.linspace(0, 1, 33)[:, None, None]
        points = np.asarray(a)[None] * (1 - steps) + np.asarray(b)[None] * steps
        return self.is_free(points.reshape(-1, 3)).reshape(points.shape[:2]).all(0)

    def floor_below(self, points):
        points = np.asarray(points)
        inside = ((points[:, :2] >= 0) & (points[:, :2] <= np.array(self.size)[:2]) & (points[:, 2:] >= 0)).all(1)
        return np.where(inside, 0.0, np.nan)


def noise_texture(rng, size=512):
    """Coloured blobs of several sizes, periodic."""
    image = np.zeros((size, size, 3))
    for sigma in (2, 4, 8, 16):
        layer = gaussian_filter(rng.normal(size=(size, size, 3)), (sigma, sigma, 0), mode="wrap")
        image += layer / layer.std()
    return np.clip(128 + 35 * image, 0, 255).astype(np.uint8)


def box_room(size=ROOM_SIZE, seed=0):
    """The inside of a box with a corner at the origin, each face with a texture of its own, 2.5 m across."""
    size_m = np.array(size)
    vertices = []
    triangles = []
    uvs = []
    textures = []
    rng = np.random.default_rng(seed)
    for axis in range(3):
        u, v = np.delete(np.arange(3), axis)
        for side in (0.0, 1.0):
            corners = np.zeros((4, 3))
            corners[:, axis] = side * size_m[axis]
            corners[:, u] = np.array([0, 1, 1, 0]) * size_m[u]
            corners[:, v] = np.array([0, 0, 1, 1]) * size_m[v]
            order = np.array([[0, 1, 2], [0, 2, 3]])
            uvs.append((corners[:, [u, v]] / 2.5)[order])
            triangles.append(order + 4 * len(vertices))
            vertices.append(corners)
            textures.append(noise_texture(rng))
    return TexturedMesh(
        vertices=np.concatenate(vertices).astype(np.float32),
        triangles=np.concatenate(triangles).astype(np.int32),
        corner_uvs=np.concatenate(uvs).astype(np.float32),
        triangle_texture=np.repeat(np.arange(6), 2).astype(np.int32),
        textures=tuple(textures),
    )


@pytest.fixture(scope="session")
def room():
    return box_room()


@pytest.fixture(scope="session")
def room_free_space():
    return BoxFreeSpace()
