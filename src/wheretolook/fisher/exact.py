"""The information in what a view really sees: field of view and occlusion as they are."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from wheretolook.fisher import exact_kernel
from wheretolook.fisher.exact_kernel import information_kernel
from wheretolook.fisher.information import N_NUMBERS, bearing_numbers
from wheretolook.fisher.parts import run_in_parts
from wheretolook.geometry.colmap_camera import Camera, ColmapCamera
from wheretolook.geometry.poses import Float, split_poses
from wheretolook.utils.warp import start_warp
from wheretolook.visibility.counting import SINGLE_ROUNDING
from wheretolook.visibility.frustum import (
    MIN_DEPTH_M,
    VisibleSets,
    frustum_sides,
    near_radius_m,
    offsets_from,
    visible_landmarks_plain,
)

CPU_VIEWS = 128
"""Views that a thread of a CPU takes at a time: some ten milliseconds."""


def exact_information(
    camera: Camera,
    cam_from_world: Float,
    points: Float,
    unoccluded: VisibleSets,
    location_rows: NDArray[np.integer[Any]],
    device: str = "cpu",
) -> Float:
    """Information on the pose of each view, summed over the landmarks it sees.

    Args:
        camera: pinhole, or any COLMAP model (in NumPy, slowly).
        cam_from_world: (B, 3, 4).
        points: (N, 3) landmarks in metres.
        unoccluded: landmarks each of L locations has a free line of sight to.
        location_rows: (B,) row of each view's location in `unoccluded`.
        device: "cpu" (all cores) or a CUDA device.

    Returns:
        (B, 15), see `wheretolook.fisher.information`.
    """
    if isinstance(camera, ColmapCamera):
        return exact_information_plain(camera, cam_from_world, points, unoccluded, location_rows)
    device = start_warp(device)
    wp.load_module(exact_kernel, device=device)  # only one thread may do that
    rotations, centers = split_poses(cam_from_world)
    sides = frustum_sides(camera, rotations)
    rows = np.asarray(location_rows, dtype=np.int32)
    numbers = np.empty((len(centers), N_NUMBERS))

    def upload(values: Any, dtype: Any) -> Any:
        return wp.array(values, dtype=dtype, device=device)

    shared = [
        upload(np.asarray(points, dtype=np.float64), wp.vec3d),
        upload(unoccluded.starts, wp.int32),
        upload(unoccluded.indices, wp.int32),
        float(SINGLE_ROUNDING * np.linalg.norm(sides[:, :4], axis=-1).max(initial=0)),
        near_radius_m(camera),
        wp.float64(MIN_DEPTH_M),
    ]

    def work(part: slice) -> None:
        views = [upload(sides[part], wp.vec3), upload(centers[part], wp.vec3d), upload(rows[part], wp.int32)]
        result: Any = wp.empty((part.stop - part.start, N_NUMBERS), dtype=wp.float64, device=device)
        wp.launch(information_kernel, result.shape[0], [*views, *shared], [result], device=device)
        numbers[part] = result.numpy()

    run_in_parts(len(centers), CPU_VIEWS if device == "cpu" else max(1, len(centers)), work, device)
    return numbers


def exact_information_plain(
    camera: Camera,
    cam_from_world: Float,
    points: Float,
    unoccluded: VisibleSets,
    location_rows: NDArray[np.integer[Any]],
) -> Float:
    """What `exact_information` computes, in NumPy."""
    seen = visible_landmarks_plain(camera, cam_from_world, points, unoccluded, location_rows)
    _, centers = split_poses(cam_from_world)
    numbers = np.zeros((len(centers), N_NUMBERS))
    for view, center in enumerate(centers):
        offsets = offsets_from(center, np.asarray(points)[seen[view]]).astype(np.float64)
        numbers[view] = bearing_numbers(offsets).sum(0)
    return numbers
