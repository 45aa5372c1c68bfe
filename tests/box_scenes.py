"""Textured scenes made of boxes and quads, whose geometry and colours are known in closed form."""

import numpy as np
from scipy.ndimage import gaussian_filter

from wheretolook.geometry.mesh import TexturedMesh

# Corners of a unit cube's faces, counter-clockwise seen from outside.
_FACES = np.array(
    [
        [[0, 0, 0], [0, 1, 0], [1, 1, 0], [1, 0, 0]],
        [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
        [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]],
        [[0, 1, 0], [0, 1, 1], [1, 1, 1], [1, 1, 0]],
        [[0, 0, 0], [0, 0, 1], [0, 1, 1], [0, 1, 0]],
        [[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]],
    ],
    dtype=np.float64,
)
_QUAD_UVS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], dtype=np.float64)


def random_texture(rng, height, width):
    return rng.integers(0, 256, (height, width, 3), dtype=np.uint8)


def quads_mesh(quads, textures, repeat=1.0, vertex_colors=None):
    """A mesh of quads (Q, 4, 3), each with texture q % len(textures), `repeat` times over: a number, or (Q, 2)."""
    quads = np.asarray(quads, dtype=np.float32)
    first = 4 * np.arange(len(quads))[:, None, None]
    triangles = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    uvs = _QUAD_UVS * np.broadcast_to(repeat, (len(quads), 2))[:, None]
    return TexturedMesh(
        quads.reshape(-1, 3),
        triangles.astype(np.int32),
        uvs.reshape(-1, 2).astype(np.float32)[triangles],
        np.repeat(np.arange(len(quads)) % len(textures), 2).astype(np.int32),
        tuple(textures),
        vertex_colors,
    )


def box_quads(low, high, inward=False):
    """The six faces (6, 4, 3) of a box, seen from outside or from inside."""
    low = np.asarray(low, dtype=np.float64)
    high = np.asarray(high, dtype=np.float64)
    quads = low + _FACES * (high - low)
    return quads[:, ::-1] if inward else quads


ROOM = (6.0, 5.0, 3.0)
CABINET = ((4.0, 0.2, 0.0), (5.8, 1.8, 2.0))
TABLE_TOP = ((1.0, 2.0, 0.70), (2.6, 3.2, 0.75))


def furnished_room(seed=0, ceiling=True, repeat=2.0):
    """A 6 x 5 x 3 m room seen from inside, with a closed cabinet and a table top; textures of odd sizes."""
    rng = np.random.default_rng(seed)
    room = box_quads((0, 0, 0), ROOM, inward=True)
    if not ceiling:
        room = room[[0, 2, 3, 4, 5]]
    quads = np.concatenate([room, box_quads(*CABINET), box_quads(*TABLE_TOP)])
    sizes = [(64, 64), (33, 57), (128, 20), (1, 1), (90, 90)]
    return quads_mesh(quads, [random_texture(rng, *size) for size in sizes], repeat)


def random_triangles(seed, n_triangles=300):
    """Random triangles about the origin with random texture coordinates (also outside [0, 1]) and vertex colours."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform(-3, 3, (n_triangles, 1, 3))
    vertices = (centers + rng.normal(scale=0.6, size=(n_triangles, 3, 3))).reshape(-1, 3)
    textures = [random_texture(rng, *size) for size in [(16, 16), (7, 31), (50, 3)]]
    return TexturedMesh(
        vertices.astype(np.float32),
        np.arange(3 * n_triangles, dtype=np.int32).reshape(-1, 3),
        rng.uniform(-2, 3, (n_triangles, 3, 2)).astype(np.float32),
        rng.integers(0, len(textures), n_triangles).astype(np.int32),
        tuple(textures),
        rng.integers(0, 256, (3 * n_triangles, 3), dtype=np.uint8) if seed % 2 else None,
    )


ROOM_SIZE = (5.0, 4.0, 2.6)
LOW_X, HIGH_X = 4, 5  # faces of a box that `box_quads` returns


def noise_texture(rng, size=512):
    """Coloured blobs of several sizes, periodic."""
    image = np.zeros((size, size, 3))
    for sigma in (2, 4, 8, 16):
        layer = gaussian_filter(rng.normal(size=(size, size, 3)), (sigma, sigma, 0), mode="wrap")
        image += layer / layer.std()
    return np.clip(128 + 35 * image, 0, 255).astype(np.uint8)


def box_room(size=ROOM_SIZE, texture_m=2.5, more_quads=(), more_textures=()):
    """The inside of a box with a corner at the origin, with a repeated texture on each face, and more quads in it."""
    rng = np.random.default_rng(0)
    faces = box_quads((0, 0, 0), size, inward=True)
    repeat = np.linalg.norm(faces[:, [1, 3]] - faces[:, :1], axis=2) / texture_m
    quads = np.concatenate([faces, np.reshape(more_quads, (-1, 4, 3))])
    textures = [*(noise_texture(rng) for _ in faces), *more_textures]
    return quads_mesh(quads, textures, np.concatenate([repeat, np.ones((len(more_textures), 2))]))
