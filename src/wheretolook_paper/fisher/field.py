"""The Fisher Information Field: factors per location whose product with a view's axis is its information."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.pose_information import N_NUMBERS
from wheretolook.geometry.poses import Float
from wheretolook.utils.warp import start_warp
from wheretolook_paper.fisher import field_kernel
from wheretolook_paper.fisher.exact import run_in_parts
from wheretolook_paper.fisher.field_kernel import numbers_kernel, process_kernel, quadratic_kernel, vec16
from wheretolook_paper.fisher.metrics import TRACE
from wheretolook_paper.fisher.soft_visibility import GaussianProcessVisibility, QuadraticVisibility, SoftVisibility

NEAREST_M = 1e-3  # landmarks nearer to a location than this are left out: their information has no bound
AT_ONCE = 512  # landmarks that are summed in single precision before their sums are summed in double


@dataclass(frozen=True, eq=False)
class FisherField:
    """Information at L locations, as factors of a soft visibility (Zhang and Scaramuzza 2020, Sec. V)."""

    locations: Float  # (L, 3) metres
    visibility: SoftVisibility  # the approximation of what is in view
    factors: Float  # (L, F, 15), see `wheretolook.geometry.pose_information` for the 15 numbers

    @classmethod
    def build(
        cls,
        locations: ArrayLike,
        points: ArrayLike,
        visibility: SoftVisibility,
        unoccluded: NDArray[np.bool_] | None = None,
        device: str = "cpu",
    ) -> FisherField:
        """Sum the information of all landmarks (N, 3) m at each of locations (L, 3) m.

        The mask (L, N) is True where the line of sight is free; None if all are. The CPU uses all cores.
        """
        at = np.asarray(locations, dtype=np.float64).reshape(-1, 3)
        landmarks = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        return cls(at, visibility, visibility.finish(field_sums(at, landmarks, visibility, unoccluded, device)))

    def information(self, row: int, axes: ArrayLike) -> Float:
        """Return the information (D, 15) at location `row` along unit optical axes (D, 3)."""
        return np.asarray(self.visibility.of_axes(np.asarray(axes, dtype=np.float64)) @ self.factors[row])

    def information_of_views(self, rows: NDArray[np.int64], axes: Float) -> Float:
        """Return the information (B, 15) of views at locations `rows` (B,) along unit optical axes (B, 3)."""
        order = np.argsort(rows, kind="stable")
        starts = np.searchsorted(rows[order], np.arange(len(self.locations) + 1))
        numbers = np.empty((len(rows), N_NUMBERS))
        for row in range(len(self.locations)):
            here = order[starts[row] : starts[row + 1]]
            numbers[here] = self.information(row, axes[here])
        return numbers


def worst_axis_of_trace(field: FisherField, row: int, axes: ArrayLike) -> Float:
    """Return the axis (3,) of (D, 3) with the smallest trace, as a probe of the field."""
    return np.asarray(axes, dtype=np.float64)[np.argmin(field.information(row, axes) @ TRACE)]


def stationary_axis_of_trace(field: FisherField, row: int) -> Float:
    """Return the unit axis (3,) along which the gradient of a quadratic field's trace is zero.

    The trace is z^T Q z + q . z + constant, so its gradient is zero at z = -Q^-1 q / 2. If Q is positive, this axis
    points away from the landmarks: the released code calls it the direction of the minimum and negates it to get the
    best one. (With the default visibility, Q is negative for cones wider than 53 degrees to a side; the axis is then
    the best one itself.)
    """
    assert isinstance(field.visibility, QuadraticVisibility)
    k1, k2, _ = field.visibility.coefficients
    xx, xy, xz, yy, yz, zz, x, y, z, _ = field.factors[row] @ TRACE
    curvature = k1 * np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    axis = -np.linalg.pinv(curvature) @ (k2 * np.array([x, y, z])) / 2
    length = np.linalg.norm(axis)
    return np.asarray(axis / length if length > 0 else np.array([0.0, 0.0, 1.0]))


def field_sums(
    locations: Float,
    points: Float,
    visibility: SoftVisibility,
    unoccluded: NDArray[np.bool_] | None = None,
    device: str = "cpu",
) -> Float:
    """Sum the information of landmarks times `visibility.of_bearings`, (L, F, 15), in single precision.

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

    # 32 locations take a GPU about 60 MB for 25,000 landmarks
    run_in_parts(len(locations), 1 if device == "cpu" else 32, work, device)
    return result


def _planes(visibility: GaussianProcessVisibility) -> NDArray[np.float32]:
    """Return the `planes` of `process_kernel`, (A, 4, 16): sixteen axes at a time, filled up with zeros."""
    planes = np.zeros((-(-visibility.n_factors // 16) * 16, 4), dtype=np.float32)
    planes[: visibility.n_factors, :3] = visibility.axes
    planes[: visibility.n_factors, 3] = -np.cos(visibility.half_angle_rad)
    planes *= visibility.steepness / 2
    return np.ascontiguousarray(planes.reshape(-1, 16, 4).transpose(0, 2, 1))
