"""Textured scenes made of boxes and quads, whose geometry and colours are known in closed form."""

import numpy as np

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
    """A mesh of quads (Q, 4, 3), each with the whole of texture q % len(textures), `repeat` times over."""
    quads = np.asarray(quads, dtype=np.float32)
    first = 4 * np.arange(len(quads))[:, None, None]
    triangles = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    uvs = np.tile(_QUAD_UVS * repeat, (len(quads), 1)).astype(np.float32)
    return TexturedMesh(
        quads.reshape(-1, 3),
        triangles.astype(np.int32),
        uvs[triangles],
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
