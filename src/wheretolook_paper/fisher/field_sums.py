"""The sums over all landmarks that make up a Fisher Information Field."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from wheretolook.geometry.pose_information import N_NUMBERS
from wheretolook.geometry.poses import Float
from wheretolook.utils.parts import run_in_parts
from wheretolook.utils.warp import start_warp
from wheretolook_paper.fisher import field_kernel
from wheretolook_paper.fisher.field_kernel import numbers_kernel, process_kernel, quadratic_kernel, vec16
from wheretolook_paper.fisher.soft_visibility import GaussianProcessVisibility, QuadraticVisibility, SoftVisibility

NEAREST_M = 1e-3  # landmarks nearer to a location than this are left out: their information has no bound
AT_ONCE = 512  # landmarks that are summed in single precision before their sums are summed in double
GPU_LOCATIONS = 32  # locations that a GPU takes at a time: about 60 MB for 25,000 landmarks


def field_sums(
    locations: Float,
    points: Float,
    visibility: SoftVisibility,
    unoccluded: NDArray[np.bool_] | None = None,
    device: str = "cpu",
) -> Float:
    """Sums over landmarks of information times what `visibility.of_bearings` gives, (L, F, 15), in single precision.

    Takes locations (L, 3) m, points (N, 3) m and a mask (L, N) as `FisherField.build` does.
    """
    device = start_warp(device)
    wp.load_module(field_kernel, device=device)  # only one thread may do that
    landmarks: Any = wp.array(points, dtype=wp.vec3d, device=device)
    nothing: Any = wp.empty((0, 0), dtype=wp.bool, device=device)
    planes: Any = None
    if isinstance(visibility, GaussianProcessVisibility):
        planes = wp.array(_planes(visibility), dtype=vec16, device=device)
    else:
        assert isinstance(visibility, QuadraticVisibility)  # there is a kernel for each
    result = np.empty((len(locations), visibility.n_factors, N_NUMBERS))

    def work(rows: slice) -> None:
        at: Any = wp.array(locations[rows], dtype=wp.vec3d, device=device)
        mask = nothing
        if unoccluded is not None:
            mask = wp.array(np.ascontiguousarray(unoccluded[rows]), dtype=wp.bool, device=device, copy=False)
        bearings: Any = wp.empty((len(at), len(points)), dtype=wp.vec3, device=device)
        numbers: Any = wp.empty(bearings.shape, dtype=vec16, device=device)
        inputs = [at, landmarks, unoccluded is not None, mask, NEAREST_M]
        wp.launch(numbers_kernel, bearings.shape, inputs, [bearings, numbers], device=device)
        parts = len(at), -(-len(points) // AT_ONCE)
        if planes is None:
            sums: Any = wp.empty((*parts, visibility.n_factors), dtype=vec16, device=device)
            wp.launch(quadratic_kernel, parts, [bearings, numbers, AT_ONCE], [sums], device=device)
            result[rows] = sums.numpy().sum(1, dtype=np.float64)[..., :N_NUMBERS]
        else:
            sums = wp.empty((*parts, len(planes), N_NUMBERS), dtype=vec16, device=device)
            wp.launch(process_kernel, sums.shape[:3], [bearings, numbers, planes, AT_ONCE], [sums], device=device)
            by_axes = np.moveaxis(sums.numpy().sum(1, dtype=np.float64), -1, 2).reshape(len(at), -1, N_NUMBERS)
            result[rows] = by_axes[:, : visibility.n_factors]

    run_in_parts(len(locations), 1 if device == "cpu" else GPU_LOCATIONS, work, device)
    return result


def _planes(visibility: GaussianProcessVisibility) -> NDArray[np.float32]:
    """The `planes` of `process_kernel`, (A, 4, 16): sixteen axes at a time, filled up with zeros."""
    planes = np.zeros((-(-visibility.n_factors // 16) * 16, 4), dtype=np.float32)
    planes[: visibility.n_factors, :3] = visibility.axes
    planes[: visibility.n_factors, 3] = -np.cos(visibility.half_angle_rad)
    planes *= visibility.steepness / 2
    return np.ascontiguousarray(planes.reshape(-1, 16, 4).transpose(0, 2, 1))
