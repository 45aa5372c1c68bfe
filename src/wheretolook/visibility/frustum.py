"""What is in a camera's view: the exact test that every kernel and its plain twin decide by.

A landmark is judged by its offset from the camera centre, computed in double precision and rounded to single precision
once. A pinhole's frustum is four planes through the centre, whose normals are rounded to single precision once too. The
sign of `normal . offset` is then computed in double precision, in which products of single-precision numbers are exact.
Neither the order of threads nor a fused multiply-add can change it, so CUDA, CPU and NumPy agree on every landmark.
Rounding the normals moves the border of the view by less than 1e-4 pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import Camera, ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import Float, split_poses
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.parts import in_threads
from wheretolook.utils.system import cores
from wheretolook.utils.warp import start_warp
from wheretolook.visibility import frustum_kernel

MIN_DEPTH_M = 2.0**-10  # a pinhole sees nothing nearer to its image plane than this (about a millimetre), or behind it

CANDIDATES_AT_ONCE = 1 << 20  # landmarks that a thread of a CPU tests for several views at a time
OFFSETS_AT_ONCE = 1 << 18  # landmarks that a COLMAP camera projects at a time
SINGLE_ROUNDING = 5e-7  # bound on the relative error of a product of two vectors of three float32: 3 * 2^-24, and room


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
    return float(SINGLE_ROUNDING * np.linalg.norm(sides[:, :4], axis=-1).max(initial=0))


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
    there: Any = frustum_kernel.Views()
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
