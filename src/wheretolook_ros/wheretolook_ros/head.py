"""A camera on a robot: fixed, or on a head with pan, tilt or both, whose joints are known over time."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from operator import itemgetter

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from wheretolook_ros.conversions import Array, finite, seconds

OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # axes of the optical frame in one with x forward, z up
SLACK_DEG = 8.0  # of a search on both sides of an angle that is fixed: half the angle between 200 directions
ROUNDING_DEG = 1e-6
KEPT = 2000  # rows of a timeline
TOLERANCE_S = 0.1  # between a time and the nearest value
LATE_S = 0.005  # a head turns by a degree within it


class Head:
    """A head in the base; the camera is where pan and tilt axes meet.

    Pan turns left, tilt turns down, as rotations about z and y do. A joint that does not move has two equal limits.

    Attributes:
        location: homogeneous coordinates (4,) in the base.
        rest: pan and tilt (2,) in radians within the limits and nearest to 0.
        searched_deg: limits of pan and tilt (2, 2), so wide that a lattice has directions in them; see `nearest`.
    """

    def __init__(
        self, mount: Sequence[float], pan_deg: ArrayLike = (-180.0, 180.0), tilt_deg: ArrayLike = (-45.0, 45.0)
    ) -> None:
        """Mount a head at (x, y, z) m with (roll, pitch, yaw) degrees in the base, with limits of its joints."""
        self.location = np.array([*mount[:3], 1.0])
        self._mounted = Rotation.from_euler("xyz", mount[3:], degrees=True)
        limits = np.array([pan_deg, tilt_deg])
        self._limits = limits.T
        self.searched_deg = limits.mean(axis=1, keepdims=True) + np.maximum(np.diff(limits) / 2, SLACK_DEG) * (-1, 1)
        self.rest = np.radians(np.clip(0, *self._limits))

    def base_from_camera(self, pan: float, tilt: float) -> Array:
        """Pose (3, 4) of the camera's optical frame with joints in radians."""
        return np.column_stack([self._turned([pan, tilt]) @ OPTICAL, self.location[:3]])

    def joints(self, directions: Array) -> Array:
        """Pan and tilt (..., 2) in radians, within the limits, that look most nearly along directions (..., 3)."""
        return np.radians(np.clip(self._angles_deg(directions), *self._limits))

    def nearest(self, directions: Array) -> tuple[Array, Array]:
        """Move directions (..., 3) of the base into the limits; also returns which are within those of a search."""
        angles = self._angles_deg(directions)
        searched = np.clip(angles, *self.searched_deg.T)
        within = np.isclose(searched, angles, rtol=0, atol=ROUNDING_DEG).all(axis=-1)
        return self._turned(self.joints(directions))[..., 0], within

    def _turned(self, joints: ArrayLike) -> Array:
        return (self._mounted * Rotation.from_euler("ZY", joints)).as_matrix()

    def _angles_deg(self, directions: Array) -> Array:
        """Pan and tilt (..., 2) of directions (..., 3) of the base, nearest to the middle of their limits."""
        x, y, z = np.moveaxis(self._mounted.inv().apply(directions), -1, 0)
        angles = np.degrees(np.stack([np.arctan2(y, x), -np.arctan2(z, np.hypot(x, y))], axis=-1))
        return angles - 360 * np.round((angles - self._limits.mean(axis=0)) / 360)


class Timeline:
    """Values of the last seconds: rows of a time and the values (N,)."""

    def __init__(self) -> None:
        self.rows: list[Array] = []

    def add(self, stamp: Time, values: Array) -> None:
        """Add values. Raises ValueError if one is not finite or, with the earlier ones discarded, if time jumped back."""
        row = finite(np.append(seconds(stamp), values))
        back = self.end() - row[0]
        if back > 0:
            self.rows = [row]
            raise ValueError(f"time jumped back by {back:.2f} s; earlier values are discarded")
        self.rows = [*self.rows[-KEPT:], row]

    def end(self) -> float:
        """Return the last time, -inf if there is none."""
        return self.rows[-1][0] if self.rows else -np.inf

    def at(self, time: float) -> Array | None:
        """Interpolate linearly; None if the next row is farther than `TOLERANCE_S`, or the last older than `LATE_S`."""
        after = bisect_left(self.rows, time, key=itemgetter(0))
        rows = np.array(self.rows[max(after - 1, 0) : after + 1])
        if len(rows) == 0 or not -TOLERANCE_S < time - rows[-1, 0] < LATE_S:
            return None
        return np.array([np.interp(time, rows[:, 0], column) for column in rows.T[1:]])
