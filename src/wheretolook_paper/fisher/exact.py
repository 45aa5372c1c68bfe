"""Exact Fisher information of views: summed over the landmarks in the field of view that are not occluded."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from wheretolook.geometry.camera import ColmapCamera
from wheretolook.geometry.pose_information import N_NUMBERS, bearing_numbers
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.utils.devices import in_threads
from wheretolook.utils.processes import cores
from wheretolook.utils.warp import start_warp
from wheretolook.visibility.frustum import (
    PosedViews,
    frustum_sides,
    landmarks_in_view_plain,
    near_radius_m,
    offsets_from,
    points_on_device,
    sets_on_device,
    sides_rounding,
    views_on_device,
)
from wheretolook_paper.fisher import exact_kernel
from wheretolook_paper.fisher.exact_kernel import information_kernel


def run_in_parts(n_rows: int, rows_at_once: int, work: Callable[[slice], None], device: str = "cpu") -> None:
    """Call `work` with slices of at most `rows_at_once` rows that cover `n_rows` rows.

    On the CPU, `work` is called from as many threads as there are cores, unless there is a single slice only. NumPy,
    PyTorch and Warp release Python's lock while they compute, so that the threads use several cores.
    """
    parts = [slice(start, min(start + rows_at_once, n_rows)) for start in range(0, n_rows, rows_at_once)]
    threads = min(len(parts), cores()) if device == "cpu" else 1
    list(in_threads(work, parts, threads))


def exact_information(views: PosedViews, device: str = "cpu") -> Float:
    """Return the information (B, 15) on the pose of each view, summed over its visible landmarks.

    The CPU uses all cores. Cameras with distortion are computed in NumPy, slowly.
    """
    if isinstance(views.camera, ColmapCamera):
        return exact_information_plain(views)
    device = start_warp(device)
    wp.load_module(exact_kernel, device=device)  # only one thread may do that
    sides = frustum_sides(views.camera, views.cam_from_world[..., :3])
    bounds = [sides_rounding(sides), near_radius_m(views.camera)]
    landmarks = points_on_device(views.points, device)
    sets = sets_on_device(views.unoccluded, device)
    numbers = np.empty((len(sides), N_NUMBERS))

    def work(part: slice) -> None:
        there = views_on_device(views, part, landmarks, sets, device)
        result: Any = wp.empty((part.stop - part.start, N_NUMBERS), dtype=wp.float64, device=device)
        wp.launch(information_kernel, result.shape[0], [there, *bounds], [result], device=device)
        numbers[part] = result.numpy()

    # 128 views are some ten milliseconds of work of a CPU thread
    run_in_parts(len(sides), 128 if device == "cpu" else max(1, len(sides)), work, device)
    return numbers


def exact_information_plain(views: PosedViews) -> Float:
    """Compute `exact_information` in NumPy."""
    seen = landmarks_in_view_plain(views)
    centers = camera_centers(views.cam_from_world)
    numbers = np.zeros((len(centers), N_NUMBERS))
    for view, center in enumerate(centers):
        offsets = offsets_from(center, views.points[seen[view]]).astype(np.float64)
        numbers[view] = bearing_numbers(offsets).sum(0)
    return numbers
