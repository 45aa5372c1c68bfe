"""How far a camera turns from one orientation to another."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.poses import Float, rotation_looking_along

TOLERANCE_DEG = 1e-5  # angles may exceed a limit by this much, for rounding


def within(angles_deg: Float, limit_deg: float) -> NDArray[np.bool_]:
    """Which angles are at most the limit, up to rounding; raises a ValueError for one that is negative or NaN."""
    if not limit_deg >= 0:
        raise ValueError(f"a limit of an angle must be at least 0 degrees, got {limit_deg}")
    return np.asarray(angles_deg <= limit_deg + TOLERANCE_DEG)


def check_axis(axis: ArrayLike) -> Float:
    """An axis (3,) of any length as a unit vector; raises a ValueError if it is not finite or has no length."""
    x, y, z = np.asarray(axis, dtype=np.float64)
    return rotation_looking_along((x, y, z))[2]


def pan_tilt_angles(axes: Float) -> tuple[Float, Float]:
    """Yaws (azimuths) and pitches (elevations) of unit axes (..., 3) in radians, (...,) each."""
    return np.arctan2(axes[..., 1], axes[..., 0]), np.arcsin(np.clip(axes[..., 2], -1, 1))


def pan_tilt_turns_deg(a: Float, b: Float) -> Float:
    """Angles (A, B) in degrees by which a pan-tilt head turns from axes (A, 3) to (B, 3), pan and tilt at even speed.

    The two axes of rotation are perpendicular, so an angle is the root of the sum of the squares of pan and tilt. It is
    never less than that of the direct rotation (`turns_deg`).
    """
    yaw_a, pitch_a = pan_tilt_angles(a)
    yaw_b, pitch_b = pan_tilt_angles(b)
    pan = np.abs(yaw_a[:, None] - yaw_b[None])
    return np.degrees(np.hypot(np.minimum(pan, 2 * np.pi - pan), pitch_a[:, None] - pitch_b[None]))


def angles_to_axis_deg(directions: Float, axis: Float) -> Float:
    """Angles (D,) in degrees between unit directions (D, 3) and a unit axis (3,), accurate at small angles too."""
    chord = np.linalg.norm(directions - axis, axis=-1)
    return np.degrees(2 * np.arcsin(np.minimum(chord / 2, 1)))


def turns_from_deg(current: ArrayLike, rotations: Float) -> Float:
    """Rotation angles (D,) in degrees from one orientation to others, cam_from_world (D, 3, 3).

    `current` is the axis (3,) of a camera without roll, or a cam_from_world rotation (3, 3). Raises ValueError if
    `current` has another shape, is not finite, no rotation, or an axis of no length.
    """
    given: Float = np.asarray(current, dtype=np.float64)
    if given.shape == (3,):
        given = rotation_looking_along(check_axis(given))
    if given.shape != (3, 3) or not np.allclose(given @ given.T, np.eye(3), atol=1e-6) or np.linalg.det(given) < 0:
        raise ValueError(f"an orientation is an axis (3,) or a rotation (3, 3), got {given}")
    return _angles_deg(given.reshape(1, 9), rotations.reshape(-1, 9))[0]


def turns_deg(directions: Float) -> Float:
    """Rotation angles (D, D) in degrees between cameras without roll that look along directions (D, 3).

    They are angles of the whole camera's rotation, as in the Active Localization Benchmark (evaluate_plan.py): 40
    degrees of yaw count as 40 at every pitch, though the optical axis of a camera pitched by 60 degrees moves by 20.
    """
    rotations = rotation_looking_along(directions).reshape(-1, 9)
    angles = _angles_deg(rotations, rotations)
    np.fill_diagonal(angles, 0)
    return np.maximum(angles, angles.T)  # symmetric to the last bit


def _angles_deg(a: NDArray[Any], b: NDArray[Any]) -> Float:
    """Angles (A, B) between rotations (A, 9) and (B, 9), from |A - B|_F^2 = 6 - 2 <A, B> = 8 sin^2(angle / 2)."""
    square = np.clip((6 - 2 * (a @ b.T)) / 8, 0, 1)
    return np.degrees(2 * np.arcsin(np.sqrt(square)))
