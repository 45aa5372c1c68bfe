"""The Fisher Information Field: factors per location whose product with a view's axis is its information."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.pose_information import N_NUMBERS, TRACE
from wheretolook.geometry.poses import Float
from wheretolook_paper.fisher.field_sums import field_sums
from wheretolook_paper.fisher.soft_visibility import QuadraticVisibility, SoftVisibility


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
