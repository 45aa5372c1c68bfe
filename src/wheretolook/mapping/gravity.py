"""Estimate the direction up in a map of photographs, from how the camera was held."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float

_ITERATIONS = 50
_MIN_RESIDUAL = np.sin(np.radians(0.5))  # limits the weights
_MIN_SPREAD = np.sin(np.radians(5.0))  # of the x axes within the level plane, to determine the plane
_MIN_SPREAD_RATIO = 3.0  # of the spread within the plane to that across it


@dataclass(frozen=True, eq=False)
class Gravity:
    """The direction up, and how well the photographs agree on it."""

    up: Float  # (3,) unit vector in the frame of the poses
    # "level": the direction most nearly perpendicular to the images' x axes. "mean": the cameras rotated too little for
    # that, so it is the mean of the images' own up directions. "given": the direction in the camera was given.
    method: Literal["level", "mean", "given"]
    residual_deg: Float  # (M,) roll of each photograph for "level", else the angle between its own up and `up`

    @property
    def rotation(self) -> Float:
        """The smallest rotation (3, 3) from `up` to z."""
        return rotation_to_z(self.up)


def estimate_gravity(cam_from_world: ArrayLike, up_in_camera: tuple[float, float, float] | None = None) -> Gravity:
    """Estimate the direction up from poses (M, 3, 4), or from up in the camera frame if that is known.

    People tilt a camera up and down but hardly roll it, so the images' x axes are level: up is the direction d with the
    least sum of |x . d|, which a minority of rolled photographs does not move. Iteratively reweighted least squares.
    """
    rotation = np.asarray(cam_from_world, dtype=np.float64)[:, :, :3]
    direction = np.array([0.0, -1.0, 0.0]) if up_in_camera is None else np.asarray(up_in_camera, dtype=np.float64)
    ups = np.einsum("mji,j->mi", rotation, direction / np.linalg.norm(direction))
    mean = _median_direction(ups)
    if up_in_camera is None:
        level = _level_direction(rotation[:, 0])
        if level is not None:
            up = level if level @ mean > 0 else -level
            return Gravity(up, "level", np.degrees(np.arcsin(np.clip(np.abs(rotation[:, 0] @ up), 0, 1))))
    residual_deg = np.degrees(np.arccos(np.clip(ups @ mean, -1, 1)))
    return Gravity(mean, "mean" if up_in_camera is None else "given", residual_deg)


def rotation_to_z(up: ArrayLike) -> Float:
    """The smallest rotation (3, 3) from a direction (3,) to z; about x if it points straight down."""
    a = np.asarray(up, dtype=np.float64)
    x, y, z = a / np.linalg.norm(a)
    if z < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    skew = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.asarray(np.eye(3) + skew + skew @ skew / (1 + z))


def _level_direction(axes: Float) -> Float | None:
    """The direction most nearly perpendicular to unit axes (M, 3); None if they do not determine it."""
    weights = np.ones(len(axes))
    for _ in range(_ITERATIONS):
        values, vectors = np.linalg.eigh((axes.T * weights) @ axes / weights.sum())
        weights = 1 / np.maximum(np.abs(axes @ vectors[:, 0]), _MIN_RESIDUAL)
    least, middle = np.sqrt(np.maximum(values[:2], 0))
    return vectors[:, 0] if middle > _MIN_SPREAD and middle > _MIN_SPREAD_RATIO * least else None


def _median_direction(directions: Float) -> Float:
    """The unit vector with nearly the least sum of angles to unit vectors (M, 3): Weiszfeld's iteration on a sphere."""
    at: Float = directions.mean(0)
    for _ in range(_ITERATIONS):
        at = at / max(float(np.linalg.norm(at)), 1e-12)
        weights = 1 / np.maximum(np.linalg.norm(directions - at, axis=1), _MIN_RESIDUAL)
        at = (directions * weights[:, None]).sum(0) / weights.sum()
    return at / max(float(np.linalg.norm(at)), 1e-12)
