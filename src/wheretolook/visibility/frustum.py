"""Which landmarks are in the field of view of a camera at given poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from wheretolook.geometry.camera import Camera, ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import Float, split_poses, unit
from wheretolook.utils.devices import in_threads
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.processes import cores
from wheretolook.utils.warp import start_warp
from wheretolook.visibility import frustum_kernel


@dataclass(frozen=True, eq=False)
class FieldOfView:
    """Lower bound on how far each direction of the camera frame is inside the field of view.

    Where the table says zero the camera itself must be asked. So one table serves every camera model, and the answer
    stays that of the model. (The table would miss a hole in the field of view smaller than a cell of the first table,
    or a lobe so narrow that it also falls between a grid of pixels. Only absurd distortion makes such.)
    """

    size: int  # cells along a side of the octahedral map
    # (size * size,) float32. Positive: every direction of the cell is in view and at least this angle from the border
    # of the field of view; negative: likewise out of view; zero: the border may pass through the cell.
    depth_rad: NDArray[np.float32]


@lru_cache(maxsize=8)
def tabulate(camera: ColmapCamera, size: int = 1024) -> FieldOfView:
    """The table of a camera, which takes half a second. The latest are kept.

    With 1024 cells along a side, it is 0.06 to 0.19 degrees from a cell's centre to its farthest corner.

    A large table is made from one with fewer cells: what is certain of a cell there is certain of its parts, and only
    the parts of the others are examined.
    """
    centers, radii = cell_centers(size)
    depth = np.zeros(size * size, dtype=np.float32)
    if size % 4 == 0 and size >= 1024:
        coarse = tabulate(camera, size // 4).depth_rad.reshape(size // 4, size // 4)
        depth = coarse.repeat(4, axis=0).repeat(4, axis=1).reshape(-1)
    cells = np.flatnonzero(depth == 0)  # of which nothing is known yet
    seen = depth > 0
    seen[cells] = camera.sees(centers[cells])
    a, b = _neighbours(cells, size)
    a, b = (cell[seen[a] != seen[b]] for cell in (a, b))
    inside = np.where(seen[a], a, b)
    outside = np.where(seen[a], b, a)
    rays, on_edge = _rays_of_image(camera)
    border = np.concatenate([_border_between(camera, centers[inside], centers[outside]), rays[on_edge]])
    between_centers = rays[~seen[cells_of(rays, size)]]  # strips and lobes too narrow for the centres
    if len(border):
        chord, _ = cKDTree(border).query(between_centers)
        between_centers = between_centers[chord > 4 * radii.max()]
    border = np.concatenate([border, between_centers])
    sign = np.where(seen[cells], 1.0, -1.0)
    most_rad = 0.25  # larger depths are clipped to this; few cells of the sphere need more
    if len(border) == 0:
        depth[cells] = sign * most_rad
        return FieldOfView(size, depth)
    reach = 2 * np.sin(most_rad / 2)
    chord, _ = cKDTree(border).query(centers[cells], distance_upper_bound=reach, workers=-1)
    angle = 2 * np.arcsin(np.minimum(chord, reach) / 2)
    # Every point of a cell is within the cell's radius of its centre. Points found on the border are at most a cell apart, so the border
    # passes within a radius of one of them. The remaining half radius is a margin.
    depth[cells] = sign * np.maximum(angle - 2.5 * radii[cells], 0)
    return FieldOfView(size, depth)


def _neighbours(cells: NDArray[np.int64], size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of cells (n,) and (n,) that share a side, of which at least one is among the given."""
    row, column = np.divmod(np.tile(cells, 4), size)
    step = np.repeat(((0, 1), (1, 0), (0, -1), (-1, 0)), len(cells), axis=0)
    row = row + step[:, 0]
    column = column + step[:, 1]
    # the map's edge folds onto itself, mirrored: beyond (row, size - 1) is (size - 1 - row, size - 1)
    across = (column < 0) | (column >= size)
    along = (row < 0) | (row >= size)
    row = np.where(across, size - 1 - row, row)
    column = np.where(along, size - 1 - column, column)
    return np.tile(cells, 4), row.clip(0, size - 1) * size + column.clip(0, size - 1)


def _rays_of_image(camera: ColmapCamera) -> tuple[Float, NDArray[np.bool_]]:
    """Unit rays (n, 3) that the camera sees through a grid of pixels and the image's edge, and which lie on it."""
    n = 2048  # pixels along each edge of the image; a fourth along each side of the grid
    side = np.linspace(1e-9, 1 - 1e-9, n)
    coarse = side[::4]
    x, y = (part.ravel() for part in np.meshgrid(coarse, coarse))
    ends = np.full(n, side[0]), np.full(n, side[-1])
    x = np.concatenate([x, side, side, *ends]) * camera.width
    y = np.concatenate([y, *ends, side, side]) * camera.height
    rays = camera.unproject(np.column_stack([x, y]))
    on_edge = np.arange(len(rays)) >= len(rays) - 4 * n
    seen = camera.sees(rays)
    return rays[seen], on_edge[seen]


def _border_between(camera: ColmapCamera, seen: Float, unseen: Float) -> Float:
    """Points (n, 3) on the border of the field of view between unit directions (n, 3) in and out of view."""
    for _ in range(20):  # of the gap between neighbouring centres: to 1e-8 rad
        middle = unit(seen + unseen)
        is_seen = camera.sees(middle)[:, None]
        seen = np.where(is_seen, middle, seen)
        unseen = np.where(is_seen, unseen, middle)
    return seen


def octahedral_directions(u: ArrayLike, v: ArrayLike) -> Float:
    """Directions (..., 3) with |x| + |y| + |z| = 1 of points (u, v) of the octahedral map, each in [-1, 1]."""
    u, v = np.broadcast_arrays(np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64))
    z = 1 - np.abs(u) - np.abs(v)
    return np.stack([*_folded(u, v, z), z], axis=-1)


def _folded(a: Float, b: Float, z: Float) -> tuple[Float, Float]:
    """Coordinates (...), those of the lower half of the octahedron (z < 0) folded over the edges; its own inverse."""
    across_a = (1 - np.abs(b)) * np.where(a >= 0, 1.0, -1.0)
    across_b = (1 - np.abs(a)) * np.where(b >= 0, 1.0, -1.0)
    return np.where(z >= 0, a, across_a), np.where(z >= 0, b, across_b)


def cell_corners(size: int) -> Float:
    """Unit directions (size + 1, size + 1, 3) of the corners of cells."""
    edge = np.arange(size + 1) / size * 2 - 1
    return unit(octahedral_directions(edge[None, :], edge[:, None]))


def cell_centers(size: int) -> tuple[Float, Float]:
    """Unit directions (size^2, 3) of cells' centres, and the angle (size^2,) rad from each to its farthest corner."""
    middle = (np.arange(size) + 0.5) / size * 2 - 1
    centers = unit(octahedral_directions(middle[None, :], middle[:, None]))
    corners = cell_corners(size)
    chords = [np.linalg.norm(centers - corners[i : i + size, j : j + size], axis=-1) for i in (0, 1) for j in (0, 1)]
    return np.asarray(centers.reshape(-1, 3)), 2 * np.arcsin(np.max(chords, axis=0) / 2).reshape(-1)


def cells_of(directions: ArrayLike, size: int) -> NDArray[np.int64]:
    """Cells (...) of directions (..., 3) of any length but zero: what `cell_of` in the kernels computes, in NumPy."""
    at = np.asarray(directions, dtype=np.float64)
    x, y, z = np.moveaxis(at / np.abs(at).sum(-1, keepdims=True), -1, 0)
    column, row = (np.clip(((part + 1) / 2 * size).astype(np.int64), 0, size - 1) for part in _folded(x, y, z))
    return row * size + column


MIN_DEPTH_M = 2.0**-10  # a pinhole sees nothing nearer to its image plane than this (about a millimetre), or behind it

CANDIDATES_AT_ONCE = 1 << 20  # landmarks that a thread of a CPU tests for several views at a time
OFFSETS_AT_ONCE = 1 << 18  # landmarks that a COLMAP camera projects at a time


@dataclass(frozen=True, eq=False)
class LandmarkSets:
    """Sets of landmarks, one for each location or view, as rows of a sparse mask."""

    starts: NDArray[np.int32]  # (L + 1,); set l is `indices[starts[l]:starts[l + 1]]`
    indices: NDArray[np.int32]  # landmark rows, ascending within a set

    def __len__(self) -> int:
        return len(self.starts) - 1

    def __getitem__(self, row: int) -> NDArray[np.int32]:
        return self.indices[self.starts[row] : self.starts[row + 1]]

    @classmethod
    def from_mask(cls, mask: NDArray[np.bool_]) -> LandmarkSets:
        """From a dense mask (L, N). Raises a ConfigError if there are more entries than an int32 counts."""
        columns = [np.empty(0, np.int32), *(np.flatnonzero(row).astype(np.int32) for row in mask)]
        return cls(_starts(mask.sum(1)), np.concatenate(columns))


def _starts(lengths: NDArray[np.integer[Any]]) -> NDArray[np.int32]:
    ends = np.cumsum(lengths, dtype=np.int64)
    if len(ends) and ends[-1] > np.iinfo(np.int32).max:
        raise ConfigError("too many landmarks for one call", value=int(ends[-1]), fix="Ask for fewer views at once.")
    return np.concatenate([[0], ends]).astype(np.int32)


class PosedViews(NamedTuple):
    """B views of landmarks, whose locations are looked up among L, so that views share what is unoccluded there."""

    camera: Camera
    cam_from_world: Float  # (B, 3, 4)
    points: Float  # (N, 3) landmarks in metres
    unoccluded: LandmarkSets  # landmarks that each of L locations has a free line of sight to
    location_rows: NDArray[np.integer[Any]]  # (B,) row of each view's location in `unoccluded`


def frustum_sides(camera: PinholeCamera, rotations: ArrayLike) -> NDArray[np.float32]:
    """Planes through the camera centre that bound the view, for cam_from_world rotations (D, 3, 3).

    Returns (D, 5, 3) vectors in the world: inward normals of the left, right, top and bottom side, and the viewing
    direction. An offset is in view if its product with left and top is at least zero (pixel 0 is in the image), that
    with right and bottom is positive (pixel `width` is not), and its depth exceeds `MIN_DEPTH_M`.
    """
    right, down, forward = np.moveaxis(np.asarray(rotations, dtype=np.float64), -2, 0)
    across = camera.fx * right
    along = camera.fy * down
    horizontal = [across + camera.cx * forward, (camera.width - camera.cx) * forward - across]
    vertical = [along + camera.cy * forward, (camera.height - camera.cy) * forward - along]
    return np.stack([*horizontal, *vertical, forward], axis=-2).astype(np.float32)


def sides_rounding(sides: NDArray[np.float32]) -> float:
    """Bound on the relative rounding error of single-precision products with the normals of `frustum_sides`."""
    # a product of two vectors of three float32 is off by 3 * 2^-24 at most, and room
    return float(5e-7 * np.linalg.norm(sides[:, :4], axis=-1).max(initial=0))


def near_radius_m(camera: PinholeCamera) -> float:
    """Distance from the camera centre beyond which every point within the four sides is deeper than `MIN_DEPTH_M`."""
    x = max(abs(camera.cx), abs(camera.width - camera.cx)) / camera.fx
    y = max(abs(camera.cy), abs(camera.height - camera.cy)) / camera.fy
    return float(1.001 * MIN_DEPTH_M * np.sqrt(1 + x**2 + y**2))


def offsets_from(location: ArrayLike, points: ArrayLike) -> NDArray[np.float32]:
    """Offsets (N, 3) of points (N, 3) from a location (3,), in metres, rounded to single precision once."""
    with np.errstate(over="ignore"):
        return (np.asarray(points, dtype=np.float64) - np.asarray(location, dtype=np.float64)).astype(np.float32)


def in_view(camera: Camera, rotations: ArrayLike, offsets: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which offsets (N, 3) m from the centre, in the world, rotations (D, 3, 3) cam_from_world of a camera see; (D, N).

    This is the definition, in NumPy. Offsets that are not finite are never seen.
    """
    with np.errstate(invalid="ignore"):
        if isinstance(camera, ColmapCamera):
            single = np.asarray(rotations, dtype=np.float32)
            return np.stack([camera.sees(rotate(rotation, offsets)) for rotation in single])
        seen = np.empty((len(np.asarray(rotations)), len(offsets)), dtype=np.bool_)
        finite = np.isfinite(offsets).all(-1)
        columns = np.ascontiguousarray(offsets.T)
        for row, sides in enumerate(frustum_sides(camera, rotations)):
            left, right, top, bottom, depth = (_dot(side, columns) for side in sides)
            in_sides = (left >= 0) & (right > 0) & (top >= 0) & (bottom > 0)
            seen[row] = in_sides & (depth > MIN_DEPTH_M) & finite
        return seen


def rotate(rotations: NDArray[np.float32], offsets: NDArray[np.float32]) -> Float:
    """Offsets (..., 3) rotated by (..., 3, 3), with products exact in float64; (..., 3)."""
    return _dot(np.moveaxis(rotations, -1, 0), np.moveaxis(offsets, -1, 0)[..., None])


def _dot(a: NDArray[np.float32], b: NDArray[np.float32]) -> Float:
    """Dot products over the first axis, summed in the order of `dot` in the kernels."""
    x, y, z = (np.asarray(part, dtype=np.float64) for part in a)
    return x * b[0] + y * b[1] + z * b[2]


def pixels_of(camera: Camera, points_cam: Float) -> Float:
    """Pixels (..., 2) of points (..., 3) in view, in the camera frame, rounded as the kernels round them."""
    if isinstance(camera, ColmapCamera):
        return camera.project(points_cam)
    return np.array([camera.fx, camera.fy]) * (points_cam[..., :2] / points_cam[..., 2:]) + (camera.cx, camera.cy)


def camera_sees(
    camera: ColmapCamera, rotations: NDArray[np.float32], rows: NDArray[np.integer[Any]], offsets: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Which offsets (n, 3) m a camera sees with the rotations (D, 3, 3) in these rows (n,), computed in blocks; (n,)."""
    seen = np.empty(len(offsets), dtype=bool)
    for begin in range(0, len(offsets), OFFSETS_AT_ONCE):
        part = slice(begin, begin + OFFSETS_AT_ONCE)
        seen[part] = camera.sees(rotate(rotations[rows[part]], offsets[part]))
    return seen


def landmarks_in_view(views: PosedViews, device: str = "cpu") -> LandmarkSets:
    """The landmarks each of B views sees (paper, Sec. 3.2): B sets. COLMAP's cameras are computed in NumPy on the CPU.

    Raises a ConfigError if there are more entries than an int32 counts; ask for fewer views then.
    """
    if isinstance(views.camera, ColmapCamera):
        return landmarks_in_view_plain(views)
    starts, indices = in_view_on_device(views, points_on_device(views.points, device), device)
    return LandmarkSets(starts, indices.numpy())


def points_on_device(points: Float, device: str = "cpu") -> Any:
    """Points (N, 3) m as a Warp array of vec3d, which several calls of `in_view_on_device` can use."""
    return wp.array(np.asarray(points, dtype=np.float64), dtype=wp.vec3d, device=start_warp(device))


def sets_on_device(sets: LandmarkSets, device: str) -> tuple[Any, Any]:
    """The starts and indices of sets of landmarks, as Warp arrays of int32."""
    return wp.array(sets.starts, dtype=wp.int32, device=device), wp.array(sets.indices, dtype=wp.int32, device=device)


def views_on_device(views: PosedViews, rows: slice, points: Any, unoccluded: tuple[Any, Any], device: str) -> Any:
    """`Views` as the kernels take them, of some of the views; points and sets are already on the device."""
    assert isinstance(views.camera, PinholeCamera)
    rotations, centers = split_poses(views.cam_from_world[rows])
    there: Any = frustum_kernel.ViewBatch()
    sides = frustum_sides(views.camera, rotations)
    there.sides = wp.array(sides, dtype=wp.vec3, device=device)
    there.rounding = sides_rounding(sides)
    there.centers = wp.array(centers, dtype=wp.vec3d, device=device)
    location_rows = np.asarray(views.location_rows[rows], dtype=np.int32)
    there.location_rows = wp.array(location_rows, dtype=wp.int32, device=device)
    there.points = points
    there.min_depth = MIN_DEPTH_M
    there.starts, there.unoccluded = unoccluded
    return there


def in_view_on_device(posed: PosedViews, points: Any, device: str = "cpu") -> tuple[NDArray[np.int32], Any]:
    """What `landmarks_in_view` gives for a pinhole: the starts (B + 1,), and the indices as a Warp array of int32.

    The points are those of `points_on_device`.
    """
    device = start_warp(device)
    wp.load_module(frustum_kernel, device=device)  # only one thread may do that
    sets = sets_on_device(posed.unoccluded, device)
    candidates = np.diff(posed.unoccluded.starts)[posed.location_rows]
    if device == "cpu":
        return _collected_on_cpu(posed, points, sets, candidates)
    views = views_on_device(posed, slice(None), points, sets, device)
    lengths: Any = wp.empty(len(candidates), dtype=wp.int32, device=device)
    # A single view is collected at once, with room for all its candidates; several are counted first.
    once = len(candidates) == 1
    first: Any = wp.zeros(1 if once else 0, dtype=wp.int32, device=device)
    indices: Any = wp.empty(int(candidates[0]) if once else 0, dtype=wp.int32, device=device)
    wp.launch(frustum_kernel.collect_kernel, len(candidates), [views, once, first], [lengths, indices], device=device)
    starts = _starts(lengths.numpy())
    if once:
        return starts, indices[: int(starts[-1])]
    indices = wp.empty(int(starts[-1]), dtype=wp.int32, device=device)
    first = wp.array(starts, dtype=wp.int32, device=device)
    wp.launch(frustum_kernel.collect_kernel, len(candidates), [views, True, first], [lengths, indices], device=device)
    return starts, indices


def _collected_on_cpu(
    posed: PosedViews, points: Any, sets: tuple[Any, Any], candidates: NDArray[np.int32]
) -> tuple[NDArray[np.int32], Any]:
    """As `in_view_on_device`: tests each view's candidates (B,) once, in blocks of views on all cores."""
    block = np.cumsum(candidates, dtype=np.int64) // CANDIDATES_AT_ONCE  # of each view
    bounds = [0, *(np.flatnonzero(np.diff(block)) + 1).tolist(), len(candidates)]

    def collect(rows: slice) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        first = _starts(candidates[rows])
        views = views_on_device(posed, rows, points, sets, "cpu")
        found: Any = wp.empty(int(first[-1]), dtype=wp.int32, device="cpu")
        lengths: Any = wp.empty(len(first) - 1, dtype=wp.int32, device="cpu")
        inputs = [views, True, wp.array(first, dtype=wp.int32, device="cpu")]
        wp.launch(frustum_kernel.collect_kernel, len(lengths), inputs, [lengths, found], device="cpu")
        numbers = lengths.numpy().copy()
        indices = found.numpy()
        parts = [indices[begin : begin + number] for begin, number in zip(first, numbers, strict=False)]
        return numbers, np.concatenate([np.empty(0, np.int32), *parts])

    blocks = [slice(begin, end) for begin, end in pairwise(bounds)]
    numbers, indices = map(np.concatenate, zip(*in_threads(collect, blocks, cores()), strict=True))
    return _starts(numbers), wp.array(indices, dtype=wp.int32, device="cpu")


def landmarks_in_view_plain(views: PosedViews) -> LandmarkSets:
    """What `landmarks_in_view` computes, in NumPy."""
    sets = []
    for rotation, center, row in zip(*split_poses(views.cam_from_world), views.location_rows, strict=True):
        candidates = views.unoccluded[row]
        offsets = offsets_from(center, views.points[candidates])
        sets.append(candidates[in_view(views.camera, rotation[None], offsets)[0]])
    lengths = np.array([len(rows) for rows in sets], dtype=np.int64)
    return LandmarkSets(_starts(lengths), np.concatenate([np.empty(0, np.int32), *sets]))


def in_view_by_table(posed: PosedViews, points: Any, device: str = "cpu") -> LandmarkSets:
    """What `landmarks_in_view` gives for a COLMAP camera, by a table of its field of view; on the host.

    The table takes a second to make, and the camera is asked only about landmarks near the border of the view. Points
    are those of `points_on_device`.
    """
    camera = posed.camera
    assert isinstance(camera, ColmapCamera)
    wp.load_module(frustum_kernel, device=device)
    field = tabulate(camera)
    rotations, centers = split_poses(posed.cam_from_world)
    single = rotations.astype(np.float32)
    inputs = [
        wp.array(single, dtype=wp.mat33, device=device),
        wp.array(centers, dtype=wp.vec3d, device=device),
        wp.array(np.asarray(posed.location_rows, dtype=np.int32), dtype=wp.int32, device=device),
        points,
        *sets_on_device(posed.unoccluded, device),
        wp.array(field.depth_rad, dtype=wp.float32, device=device),
        field.size,
    ]
    lengths: Any = wp.empty(len(single), dtype=wp.int64, device=device)
    none: list[Any] = [wp.empty(0, dtype=dtype, device=device) for dtype in (wp.int64, wp.int32)]
    kernel = frustum_kernel.collect_field_kernel
    wp.launch(kernel, len(single), [*inputs, False, none[0]], [lengths, none[1]], device=device)
    starts = np.concatenate([[0], np.cumsum(lengths.numpy())])
    found: Any = wp.empty(int(starts[-1]), dtype=wp.int32, device=device)
    first: Any = wp.array(starts[:-1], dtype=wp.int64, device=device)
    wp.launch(kernel, len(single), [*inputs, True, first], [lengths, found], device=device)
    indices = found.numpy()

    def sees(view: NDArray[np.int64], rows: NDArray[np.int32]) -> NDArray[np.bool_]:
        offsets = (posed.points[rows] - centers[view]).astype(np.float32)
        return camera_sees(camera, single, view, offsets)

    kept, starts = decided(indices, starts, sees)
    return LandmarkSets(starts.astype(np.int32), indices[kept])


def decided(
    entries: NDArray[np.int32],
    starts: NDArray[np.int64],
    sees: Callable[[NDArray[np.int64], NDArray[np.int32]], NDArray[np.bool_]],
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Decide the entries (E,) of V views that the table left to the camera; these are -1 - row, and become rows.

    `sees` returns which of such entries are in view, from their views and rows. Returns which entries are, (E,), and
    the starts (V + 1,) of the views among them.
    """
    unsure = np.flatnonzero(entries < 0)
    entries[unsure] = -1 - entries[unsure]
    view = np.searchsorted(starts, unsure, side="right") - 1
    kept = np.ones(len(entries), dtype=bool)
    kept[unsure] = sees(view, entries[unsure])
    n_lost = np.bincount(view[~kept[unsure]], minlength=len(starts) - 1)
    return kept, np.concatenate([[0], np.cumsum(np.diff(starts) - n_lost)])
