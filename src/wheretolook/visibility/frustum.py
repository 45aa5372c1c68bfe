"""What is inside a camera's view: the exact test that every kernel and every twin decides by.

A landmark is judged by its offset from the camera centre, taken in double precision and rounded to single once. A
pinhole frustum is four planes through the centre whose normals are rounded to single once too. The sign of
`normal . offset` is then taken in double precision, where products of single-precision numbers are exact: neither the
order of threads nor a fused multiply-add can change it, so CUDA, CPU and NumPy agree to the last landmark. Against
unrounded normals the border moves by less than 1e-4 pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.colmap_camera import Camera, ColmapCamera
from wheretolook.geometry.poses import Float, split_poses
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.warp import start_warp
from wheretolook.visibility.frustum_kernel import collect_kernel

MIN_DEPTH_M = 2.0**-10
"""A pinhole does not see what is nearer to its image plane than this (about a millimetre), or behind it."""


@dataclass(frozen=True, eq=False)
class VisibleSets:
    """Sets of landmarks, one for each location or view, as rows of a sparse mask.

    Attributes:
        starts: (L + 1,) int32; row l is `indices[starts[l]:starts[l + 1]]`.
        indices: landmark rows, int32, ascending within a row.
    """

    starts: NDArray[np.int32]
    indices: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.starts) - 1

    def __getitem__(self, row: int) -> NDArray[np.int32]:
        """Landmark rows of one set."""
        return self.indices[self.starts[row] : self.starts[row + 1]]

    @classmethod
    def from_mask(cls, mask: NDArray[np.bool_]) -> VisibleSets:
        """From a dense mask (L, N).

        Raises:
            ConfigError: there are more entries than an int32 counts.
        """
        lengths = mask.sum(1)
        columns = np.flatnonzero(mask) - np.repeat(np.arange(len(mask)) * mask.shape[1], lengths)
        return cls(_starts(lengths), columns.astype(np.int32))


def _starts(lengths: NDArray[np.integer[Any]]) -> NDArray[np.int32]:
    ends = np.cumsum(lengths, dtype=np.int64)
    if len(ends) and ends[-1] > np.iinfo(np.int32).max:
        raise ConfigError("too many visible landmarks for one call", value=int(ends[-1]), fix="Ask for fewer at once.")
    return np.concatenate([[0], ends]).astype(np.int32)


def frustum_sides(camera: PinholeCamera, rotations: ArrayLike) -> NDArray[np.float32]:
    """Planes through the camera centre that bound the view.

    Args:
        camera: pinhole intrinsics.
        rotations: (D, 3, 3) cam_from_world.

    Returns:
        (D, 5, 3) vectors in the world: inward normals of the left, right, top and bottom side, and the viewing
        direction. An offset is in view if its product with left and top is at least zero (pixel 0 is in the image),
        that with right and bottom is positive (pixel `width` is not), and its depth exceeds `MIN_DEPTH_M`.
    """
    right, down, forward = np.moveaxis(np.asarray(rotations, dtype=np.float64), -2, 0)
    f, cx, cy = camera.focal_px, camera.cx, camera.cy
    sides = [f * right + cx * forward, (camera.width - cx) * forward - f * right,
             f * down + cy * forward, (camera.height - cy) * forward - f * down, forward]  # fmt: skip
    return np.stack(sides, axis=-2).astype(np.float32)


def near_radius_m(camera: PinholeCamera) -> float:
    """Farther from the camera centre than this, whatever lies inside the four sides exceeds `MIN_DEPTH_M` too."""
    return float(1.001 * MIN_DEPTH_M * np.sqrt(1 + (camera.cx**2 + camera.cy**2) / camera.focal_px**2))


def offsets_from(location: ArrayLike, points: ArrayLike) -> NDArray[np.float32]:
    """Offsets (N, 3) of points (N, 3) m from a location (3,) m, as they are judged."""
    with np.errstate(over="ignore"):
        return (np.asarray(points, dtype=np.float64) - np.asarray(location, dtype=np.float64)).astype(np.float32)


def in_view(camera: Camera, rotations: ArrayLike, offsets: NDArray[np.float32]) -> NDArray[np.bool_]:
    """The definition, in NumPy: which offsets each orientation of a camera sees.

    Args:
        camera: pinhole, or any COLMAP model.
        rotations: (D, 3, 3) cam_from_world.
        offsets: (N, 3) from the camera centre, in the world, metres.

    Returns:
        (D, N); offsets that are not finite are never seen.
    """
    with np.errstate(invalid="ignore"):
        if isinstance(camera, ColmapCamera):
            return np.stack([camera.sees(rotate(one, offsets)) for one in np.asarray(rotations, dtype=np.float32)])
        seen = np.empty((len(np.asarray(rotations)), len(offsets)), dtype=np.bool_)
        finite, columns = np.isfinite(offsets).all(-1), np.ascontiguousarray(offsets.T)
        for row, sides in enumerate(frustum_sides(camera, rotations)):
            left, right, top, bottom, depth = (_dot(side, columns) for side in sides)
            in_sides = (left >= 0) & (right > 0) & (top >= 0) & (bottom > 0)
            seen[row] = in_sides & (depth > MIN_DEPTH_M) & finite
        return seen


def rotate(rotations: NDArray[np.float32], offsets: NDArray[np.float32]) -> Float:
    """Offsets (..., 3) turned by rotations (..., 3, 3), the products exact in float64; (..., 3)."""
    return _dot(np.moveaxis(rotations, -1, 0), np.moveaxis(offsets, -1, 0)[..., None])


def _dot(a: NDArray[np.float32], b: NDArray[np.float32]) -> Float:
    """Products over the first axis in the order of `dot` in the kernels."""
    x, y, z = (np.asarray(part, dtype=np.float64) for part in a)
    return x * b[0] + y * b[1] + z * b[2]


def pixels_of(camera: Camera, points_cam: Float) -> Float:
    """Pixel coordinates (..., 2) of visible points (..., 3) of the camera frame, rounded as the kernels round them."""
    if isinstance(camera, ColmapCamera):
        return camera.project(points_cam)
    return camera.focal_px * (points_cam[..., :2] / points_cam[..., 2:]) + (camera.cx, camera.cy)


def visible_landmarks(
    camera: Camera,
    cam_from_world: Float,
    points: Float,
    unoccluded: VisibleSets,
    location_rows: NDArray[np.integer[Any]],
    device: str = "cpu",
) -> VisibleSets:
    """The landmarks each view sees (paper, Sec. 3.2).

    Args:
        camera: pinhole, or any COLMAP model.
        cam_from_world: (B, 3, 4).
        points: (N, 3) landmarks in metres.
        unoccluded: landmarks each of L locations has a free line of sight to.
        location_rows: (B,) row of each view's location in `unoccluded`.
        device: "cpu" or a CUDA device; one thread a view.

    Returns:
        B sets of landmark rows, ascending.

    Raises:
        ConfigError: there are more entries than an int32 counts; ask for fewer views.
    """
    if isinstance(camera, ColmapCamera):
        return visible_landmarks_plain(camera, cam_from_world, points, unoccluded, location_rows)
    there = points_on_device(points, device)
    starts, indices = visible_on_device(camera, cam_from_world, there, unoccluded, location_rows, device)
    return VisibleSets(starts, indices.numpy())


def points_on_device(points: Float, device: str = "cpu") -> Any:
    """Points (N, 3) m as the Warp array that `visible_on_device` takes, to be used again."""
    return wp.array(np.asarray(points, dtype=np.float64), dtype=wp.vec3d, device=start_warp(device))


def visible_on_device(
    camera: PinholeCamera,
    cam_from_world: Float,
    points: Any,
    unoccluded: VisibleSets,
    location_rows: NDArray[np.integer[Any]],
    device: str = "cpu",
) -> tuple[NDArray[np.int32], Any]:
    """What `visible_landmarks` gives for a pinhole: the starts (B + 1,), and the indices as a Warp array of int32.

    The points are those of `points_on_device`.
    """
    device = start_warp(device)
    rotations, centers = split_poses(cam_from_world)
    inputs: list[Any] = [
        wp.array(frustum_sides(camera, rotations), dtype=wp.vec3, device=device),
        wp.array(centers, dtype=wp.vec3d, device=device),
        wp.array(np.asarray(location_rows, dtype=np.int32), dtype=wp.int32, device=device),
        points,
        wp.array(unoccluded.starts, dtype=wp.int32, device=device),
        wp.array(unoccluded.indices, dtype=wp.int32, device=device),
        wp.float64(MIN_DEPTH_M),
    ]
    lengths: Any = wp.empty(len(centers), dtype=wp.int32, device=device)
    if len(centers) == 1:  # no need to count before there is room
        starts_there: Any = wp.zeros(1, dtype=wp.int32, device=device)
        indices: Any = wp.empty(len(unoccluded[int(location_rows[0])]), dtype=wp.int32, device=device)
        wp.launch(collect_kernel, 1, [*inputs, True, starts_there], [lengths, indices], device=device)
        starts = _starts(lengths.numpy())
        return starts, indices[: int(starts[-1])]
    nothing: Any = wp.empty(0, dtype=wp.int32, device=device)
    wp.launch(collect_kernel, len(centers), [*inputs, False, nothing], [lengths, nothing], device=device)
    starts = _starts(lengths.numpy())
    indices = wp.empty(int(starts[-1]), dtype=wp.int32, device=device)
    starts_there = wp.array(starts, dtype=wp.int32, device=device)
    wp.launch(collect_kernel, len(centers), [*inputs, True, starts_there], [lengths, indices], device=device)
    return starts, indices


def visible_landmarks_plain(
    camera: Camera,
    cam_from_world: Float,
    points: Float,
    unoccluded: VisibleSets,
    location_rows: NDArray[np.integer[Any]],
) -> VisibleSets:
    """What `visible_landmarks` computes, in NumPy."""
    sets = []
    for rotation, center, row in zip(*split_poses(cam_from_world), location_rows, strict=True):
        candidates = unoccluded[row]
        sets.append(candidates[in_view(camera, rotation[None], offsets_from(center, points[candidates]))[0]])
    lengths = np.array([len(rows) for rows in sets], dtype=np.int64)
    return VisibleSets(_starts(lengths), np.concatenate([np.empty(0, np.int32), *sets]))
