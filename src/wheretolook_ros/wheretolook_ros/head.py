"""A camera on a robot: fixed, or on a pan-tilt head whose joints are known over time."""

from __future__ import annotations

import bisect
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from wheretolook_ros.conversions import Array

OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # axes of the optical frame in one with x forward, z up


ROUNDING_DEG = 1e-6
KEPT_S = 10.0  # of a timeline
TOLERANCE_S = 0.1  # between a time and the nearest value
LATE_S = 0.005  # a head turns by a degree within it


@dataclass(frozen=True)
class Head:
    """A head at (x, y, z) m with (roll, pitch, yaw) degrees in the base; the camera is where pan and tilt axes meet.

    Pan turns left, tilt turns down, as rotations about z and y do. Limits are in degrees.
    """

    mount: tuple[float, ...]
    pan_deg: tuple[float, float] = (-180.0, 180.0)
    tilt_deg: tuple[float, float] = (-45.0, 45.0)

    def base_from_camera(self, pan: float, tilt: float) -> Array:
        """Pose (3, 4) of the camera's optical frame with joints in radians."""
        turned = self._rotation() * Rotation.from_euler("ZY", [pan, tilt])
        return np.column_stack([turned.as_matrix() @ OPTICAL, self.mount[:3]])

    def joints(self, direction: Array) -> list[float]:
        """Pan and tilt in radians, within the limits, that look most nearly along a direction (3,) of the base."""
        return list(np.radians(self._within(self._angles_deg(direction))))

    def allows(self, directions: Array) -> Array:
        """Which directions (D, 3) of the base are within the limits, (D,) bool."""
        angles = self._angles_deg(directions)
        return np.asarray(np.isclose(self._within(angles), angles, rtol=0, atol=ROUNDING_DEG).all(axis=1))

    def _angles_deg(self, directions: Array) -> Array:
        """Pan and tilt (..., 2) of directions (..., 3) of the base."""
        x, y, z = np.moveaxis(self._rotation().inv().apply(directions), -1, 0)
        return np.degrees(np.stack([np.arctan2(y, x), -np.arctan2(z, np.hypot(x, y))], axis=-1))

    def _within(self, angles: Array) -> Array:
        return np.clip(angles, *np.transpose([self.pan_deg, self.tilt_deg]))

    def _rotation(self) -> Rotation:
        return Rotation.from_euler("xyz", self.mount[3:], degrees=True)


@dataclass
class Timeline:
    """Values (N,) by their time, of the last seconds."""

    times: list[float] = field(default_factory=list)
    values: list[Array] = field(default_factory=list)

    def add(self, time: float, value: Array) -> bool:
        """Add a value; returns False, and forgets the earlier ones, if time jumped back."""
        forward = not self.times or time >= self.times[-1]
        if not forward:
            self.times.clear()
            self.values.clear()
        self.times.append(time)
        self.values.append(value)
        old = bisect.bisect_left(self.times, time - KEPT_S)
        del self.times[:old], self.values[:old]
        return forward

    def at(self, time: float) -> Array | None:
        """Interpolate linearly; None if the next value is farther than `TOLERANCE_S`, or the last older than `LATE_S`."""
        after = bisect.bisect_left(self.times, time)
        rows = slice(max(after - 1, 0), after + 1)
        times = np.array(self.times[rows])
        if len(times) == 0 or not -TOLERANCE_S < time - times[-1] < LATE_S:
            return None
        values = np.array(self.values[rows])
        if len(values[0]) == 7 and values[0, 3:] @ values[-1, 3:] < 0:  # the same rotation by the other quaternion
            values[-1, 3:] *= -1
        return np.array([np.interp(time, times, column) for column in values.T])
