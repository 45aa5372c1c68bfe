"""The information in what a view really sees: its field of view and occlusion as they are."""

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
from wheretolook.visibility.frustum import (
    LandmarkSets,
    frustum_sides,
    landmarks_in_view_plain,
    near_radius_m,
    offsets_from,
    points_on_device,
    sets_on_device,
    sides_rounding,
    views_on_device,
)

CPU_VIEWS = 128  # views that a CPU thread takes at a time: some ten milliseconds of work


def exact_information(
    camera: Camera,
    cam_from_world: Float,
    points: Float,
    unoccluded: LandmarkSets,
    location_rows: NDArray[np.integer[Any]],
    device: str = "cpu",
) -> Float:
    """Information on the pose of each view, summed over the landmarks it sees.

    Takes what `landmarks_in_view` takes: poses (B, 3, 4), points (N, 3) m, the sets of L locations, and the location
    (B,) of each view. The CPU works with all its cores, on cameras with distortion in NumPy and slowly.

    Returns:
        (B, 15), see `wheretolook.fisher.information`.
    """
    if isinstance(camera, ColmapCamera):
        return exact_information_plain(camera, cam_from_world, points, unoccluded, location_rows)
    device = start_warp(device)
    wp.load_module(exact_kernel, device=device)  # only one thread may do that
    poses, rows = np.asarray(cam_from_world), np.asarray(location_rows)
    bounds = [sides_rounding(frustum_sides(camera, poses[..., :3])), near_radius_m(camera)]
    landmarks, sets = points_on_device(points, device), sets_on_device(unoccluded, device)
    numbers = np.empty((len(poses), N_NUMBERS))

    def work(part: slice) -> None:
        views = views_on_device(camera, poses[part], landmarks, sets, rows[part], device)
        result: Any = wp.empty((part.stop - part.start, N_NUMBERS), dtype=wp.float64, device=device)
        wp.launch(information_kernel, result.shape[0], [views, *bounds], [result], device=device)
        numbers[part] = result.numpy()

    run_in_parts(len(poses), CPU_VIEWS if device == "cpu" else max(1, len(poses)), work, device)
    return numbers


def exact_information_plain(
    camera: Camera,
    cam_from_world: Float,
    points: Float,
    unoccluded: LandmarkSets,
    location_rows: NDArray[np.integer[Any]],
) -> Float:
    """What `exact_information` computes, in NumPy."""
    seen = landmarks_in_view_plain(camera, cam_from_world, points, unoccluded, location_rows)
    _, centers = split_poses(cam_from_world)
    numbers = np.zeros((len(centers), N_NUMBERS))
    for view, center in enumerate(centers):
        offsets = offsets_from(center, np.asarray(points)[seen[view]]).astype(np.float64)
        numbers[view] = bearing_numbers(offsets).sum(0)
    return numbers
