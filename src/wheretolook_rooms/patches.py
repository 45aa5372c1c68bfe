"""The generator's only geometric primitive: a grid of vertices that maps onto a rectangle of texture.

Every surface, from a wall to a leaf, is a `Patch`. Seen from its front, s runs right and t runs down, like the columns
and rows of its texture, and triangles are counter-clockwise. The surface of a solid is closed by several patches.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any, ParamSpec

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook_rooms.materials import Material

Float = NDArray[np.floating[Any]]
P = ParamSpec("P")

HIDDEN = 0.2  # texel density, relative to other faces, of faces that stand against a wall or on the floor


@dataclass(frozen=True, eq=False)
class Patch:
    """A grid of (m, n) cells."""

    positions: Float  # (m + 1, n + 1, 3) metres; row = t (down), column = s (right), seen from the front
    s: Float  # (n + 1,) texture coordinate of the columns, 0 to 1
    t: Float  # (m + 1,) texture coordinate of the rows, 0 to 1
    size_m: tuple[float, float]  # width and height of the surface, which set the number of texels
    material: Material
    room: int = 0  # index of the room whose lamps and windows light it best
    density: float = 1.0  # texels per metre relative to the apartment's
    mask: NDArray[np.bool_] | None = None  # (m, n) False for cells that are holes
    offset_m: tuple[float, float] = (0.0, 0.0)  # where the painted pattern starts, right and down
    piece: object = None  # of what it is a part that can be moved as a whole; None if fixed

    def triangles(self) -> tuple[NDArray[np.int64], Float]:
        """Triangles as indices into the flattened grid (T, 3) and the (s, t) of their corners (T, 3, 2)."""
        m = len(self.t) - 1
        n = len(self.s) - 1
        row, column = np.mgrid[0:m, 0:n]
        cells = row * (n + 1) + column
        top_left = cells.ravel() if self.mask is None else cells[self.mask]
        bottom_left = top_left + n + 1
        left = np.stack([top_left, bottom_left, bottom_left + 1], 1)
        right = np.stack([top_left, bottom_left + 1, top_left + 1], 1)
        triangles = np.concatenate([left, right])
        corners = self.positions.reshape(-1, 3)[triangles]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        triangles = triangles[area > 1e-9]  # the poles of closed surfaces of revolution
        return triangles, np.stack([self.s[triangles % (n + 1)], self.t[triangles // (n + 1)]], -1)


def grid_patch(positions: Float, material: Material, size_m: tuple[float, float], **options: Any) -> Patch:
    """Patch over an evenly parametrized grid of positions (m + 1, n + 1, 3)."""
    m = positions.shape[0] - 1
    n = positions.shape[1] - 1
    return Patch(positions, np.linspace(0, 1, n + 1), np.linspace(0, 1, m + 1), size_m, material, **options)


def plane(origin: ArrayLike, right: ArrayLike, down: ArrayLike, material: Material, **options: Any) -> Patch:
    """Flat rectangle: top-left corner, and the edges that run right and down seen from its front (metres)."""
    o, u, v = (np.asarray(a, float) for a in (origin, right, down))
    positions = np.stack([np.stack([o, o + u]), np.stack([o + v, o + u + v])])
    size = (float(np.linalg.norm(u)), float(np.linalg.norm(v)))
    return grid_patch(positions, material, size, **options)


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles of many patches."""

    vertices: Float  # (V, 3) metres
    triangles: NDArray[np.int64]  # (T, 3) vertex indices
    patch: NDArray[np.int64]  # (T,) the patch each triangle belongs to
    st: Float  # (T, 3, 2) patch coordinates of the corners


def join(patches: Sequence[Patch]) -> Surface:
    """All patches as one set of triangles."""
    triangles, st = zip(*(p.triangles() for p in patches), strict=True)
    vertices = [p.positions.reshape(-1, 3) for p in patches]
    first = np.concatenate([[0], np.cumsum([len(v) for v in vertices])[:-1]])
    numbered = np.concatenate([of_patch + start for of_patch, start in zip(triangles, first, strict=True)])
    patch = np.repeat(np.arange(len(patches)), [len(of_patch) for of_patch in triangles])
    return Surface(np.concatenate(vertices), numbered, patch, np.concatenate(st))


# Faces of a box in the furniture frame: y points from the wall into the room (front = +y), z up. For each, the corner
# it starts at, right and down, as signs on the half extents.
FACES: dict[str, tuple[tuple[int, int, int], tuple[int, int, int], tuple[int, int, int]]] = {
    "front": ((1, 1, 1), (-1, 0, 0), (0, 0, -1)),
    "back": ((-1, -1, 1), (1, 0, 0), (0, 0, -1)),
    "right": ((1, -1, 1), (0, 1, 0), (0, 0, -1)),
    "left": ((-1, 1, 1), (0, -1, 0), (0, 0, -1)),
    "top": ((-1, 1, 1), (1, 0, 0), (0, -1, 0)),
    "bottom": ((-1, -1, -1), (1, 0, 0), (0, 1, 0)),
}


def _face_options(number: int, hidden: bool, density: float, offset_m: tuple[float, float]) -> dict[str, Any]:
    """Options of one face's patch: fewer texels if hidden, and a pattern that starts elsewhere on each face."""
    offset = (offset_m[0] + 0.37 * number, offset_m[1] + 0.23 * number)
    return {"density": density * (HIDDEN if hidden else 1.0), "offset_m": offset}


def box(
    low: ArrayLike,
    high: ArrayLike,
    material: Material,
    *,
    faces: Mapping[str, Material] | None = None,
    hidden: Collection[str] = ("bottom",),
    offset_m: tuple[float, float] = (0.0, 0.0),
    density: float = 1.0,
) -> list[Patch]:
    """Closed axis-aligned box from corner `low` to corner `high`; `faces` overrides the material of single faces."""
    lo = np.asarray(low, float)
    hi = np.asarray(high, float)
    centre = (lo + hi) / 2
    half = (hi - lo) / 2
    patches = []
    for i, (face, signs) in enumerate(FACES.items()):
        corner, right, down = (half * np.array(sign) for sign in signs)
        options = _face_options(i, face in hidden, density, offset_m)
        patches.append(plane(centre + corner, 2 * right, 2 * down, (faces or {}).get(face, material), **options))
    return patches


def cushion(
    low: ArrayLike,
    high: ArrayLike,
    material: Material,
    *,
    radius_m: float = 0.05,
    puff: tuple[float, float, float] = (0.0, 0.0, 0.0),
    rounding: int = 3,
    span: int = 4,
    hidden: Collection[str] = ("bottom",),
) -> list[Patch]:
    """Box with rounded edges; `puff` (metres per axis) swells the middle of its faces outwards."""
    lo = np.asarray(low, float)
    hi = np.asarray(high, float)
    centre = (lo + hi) / 2
    half = (hi - lo) / 2
    radius = min(radius_m, float(half.min()) * 0.999)

    def knots(extent: float) -> Float:
        # Even angles on the rounded edge, as the point h - r + r tan(a) of the box's face is moved to angle a.
        edge = extent - radius + radius * np.tan(np.linspace(0, np.pi / 4, rounding + 1))
        middle = np.linspace(-(extent - radius), extent - radius, span + 1)[1:-1]
        return np.concatenate([-edge[::-1], middle, edge])

    patches = []
    for i, (face, (corner, right, down)) in enumerate(FACES.items()):
        c = np.array(corner)
        u = np.array(right)
        v = np.array(down)
        a = knots(float(half[u != 0][0]))
        b = knots(float(half[v != 0][0]))
        fixed = c * ((u == 0) & (v == 0))
        q = fixed * half + a[None, :, None] * u + b[:, None, None] * v
        core = np.clip(q, -(half - radius), half - radius)
        d = q - core
        p = core + radius * d / np.linalg.norm(d, axis=-1, keepdims=True)
        unit = np.clip(p / half, -1, 1)
        for axis in range(3):
            others = [k for k in range(3) if k != axis]
            bulge = np.prod(1 - unit[..., others] ** 2, axis=-1)
            p[..., axis] += puff[axis] * np.sign(unit[..., axis]) * np.abs(unit[..., axis]) ** 0.5 * bulge
        s = (a - a[0]) / (a[-1] - a[0])
        t = (b - b[0]) / (b[-1] - b[0])
        size = (2 * float(half[u != 0][0]), 2 * float(half[v != 0][0]))
        patches.append(Patch(centre + p, s, t, size, material, **_face_options(i, face in hidden, 1.0, (0.0, 0.0))))
    return patches


def lathe(
    profile: ArrayLike, material: Material, *, sides: int = 16, centre: ArrayLike = (0, 0, 0), density: float = 1.0
) -> list[Patch]:
    """Surface of revolution about z; `profile` lists (radius, z) downwards, radius 0 at both ends closes it."""
    rz = np.asarray(profile, float)
    angle = _full_turn(sides)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    positions = np.empty((len(rz), sides + 1, 3))
    positions[..., :2] = rz[:, None, :1] * ring[None]
    positions[..., 2] = rz[:, None, 1]
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(rz, axis=0), axis=1))])
    size = (2 * np.pi * float(rz[:, 0].max()), float(arc[-1]))
    s = np.linspace(0, 1, sides + 1)
    t = arc / arc[-1]
    return [Patch(positions + np.asarray(centre, float), s, t, size, material, density=density)]


def _full_turn(sides: int) -> Float:
    """Angles (sides + 1,) around a circle; the last is the first, exactly."""
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    angle[-1] = 0.0
    return angle


def cylinder(radius_m: float, z0: float, z1: float, material: Material, **options: Any) -> list[Patch]:
    """Closed cylinder about z."""
    return lathe([(0, z1), (radius_m, z1), (radius_m, z0), (0, z0)], material, **options)


def tube(path: ArrayLike, radius_m: ArrayLike, material: Material, *, sides: int = 8) -> list[Patch]:
    """Closed tube along a polyline (K, 3), with one radius or one per point."""
    points = np.asarray(path, float)
    tangent = np.gradient(points, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    radii = np.broadcast_to(np.asarray(radius_m, float), (len(points),))
    points, tangent = (np.pad(values, ((1, 1), (0, 0)), "edge") for values in (points, tangent))
    radii = np.pad(radii, 1)  # the ends taper to a point
    helper = np.array([0.0, 0.0, 1.0]) if abs(tangent[:, 2]).max() < 0.9 else np.array([0.31, 0.95, 0.0])
    side = np.cross(tangent, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(tangent, side)
    angle = _full_turn(sides)
    ring = np.cos(angle)[None, :, None] * side[:, None] - np.sin(angle)[None, :, None] * other[:, None]
    positions = points[:, None] + radii[:, None, None] * ring
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    return [grid_patch(positions, material, (2 * np.pi * float(radii.max()), length))]


def slab_between(front: Float, back: Float, material: Material, size_m: tuple[float, float]) -> list[Patch]:
    """Closed sheet from two grids (m + 1, n + 1, 3) of equal shape, both indexed as seen from the front."""
    edges = (
        np.stack([back[0], front[0]]),  # top
        np.stack([front[-1], back[-1]]),  # bottom
        np.stack([back[:, 0], front[:, 0]], 1),  # left
        np.stack([front[:, -1], back[:, -1]], 1),  # right
    )
    patches = [grid_patch(front, material, size_m), grid_patch(back[:, ::-1], material, size_m)]
    for i, edge in enumerate(edges):
        thickness = max(float(np.linalg.norm(edge[0, 0] - (edge[1, 0] if i < 2 else edge[0, 1]))), 0.004)
        size = (size_m[0], thickness) if i < 2 else (thickness, size_m[1])
        patches.append(grid_patch(edge, material, size))
    return patches


def move(
    patches: Iterable[Patch], *, rotation: ArrayLike | None = None, angle_rad: float = 0.0, shift: ArrayLike = (0, 0, 0)
) -> list[Patch]:
    """Patches rotated (a (3, 3) matrix, or an angle about z) and then shifted."""
    if rotation is None:
        c = np.cos(angle_rad)
        s = np.sin(angle_rad)
        rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    matrix = np.asarray(rotation, float)
    offset = np.asarray(shift, float)
    return [replace(p, positions=p.positions @ matrix.T + offset) for p in patches]


def movable(make: Callable[P, list[Patch]]) -> Callable[P, list[Patch]]:
    """Decorate a function so that the patches it returns are one piece, which `variant.changed` may move."""

    @wraps(make)
    def made(*args: P.args, **options: P.kwargs) -> list[Patch]:
        piece = object()
        return [replace(p, piece=piece) for p in make(*args, **options)]

    return made


def tilted_back(patches: Iterable[Patch], angle_rad: float) -> list[Patch]:
    """Patches turned about the x axis so that their tops lean towards -y."""
    c = np.cos(angle_rad)
    s = np.sin(angle_rad)
    return move(patches, rotation=[[1, 0, 0], [0, c, -s], [0, s, c]])
