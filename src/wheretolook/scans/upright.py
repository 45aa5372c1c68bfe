"""Estimate the direction up in a recording, from how the camera was held and from floors and walls."""

from __future__ import annotations

import numpy as np

from wheretolook.geometry.mesh import TexturedMesh
from wheretolook.geometry.poses import Float
from wheretolook.mapping.gravity import estimate_gravity

_ROUNDS_DEG = (45.0,) * 5 + (15.0,) * 5
_IS_Z_DEG = 3.0  # a world this close to upright counts as upright


def find_up(cam_from_world: Float, mesh: TexturedMesh) -> Float:
    """Estimate the unit direction up (3,) in the frame of poses (F, 3, 4) and of a mesh of the recording.

    Starts from `estimate_gravity`, then refines it by the mesh: floors and walls are perpendicular or parallel to up
    (Gupta, Arbelaez and Malik, "Perceptual Organization and Recognition of Indoor Scenes from RGB-D Images", CVPR
    2013), weighted by area. z itself if it is that to within 3 degrees.
    """
    up = estimate_gravity(cam_from_world).up
    normals = mesh.normals
    area = np.linalg.norm(normals, axis=1)
    units = normals / np.maximum(area, 1e-12)[:, None]
    for limit_deg in _ROUNDS_DEG:
        along = units @ up
        level = np.abs(along) > np.cos(np.radians(limit_deg))
        upright = np.abs(along) < np.sin(np.radians(limit_deg))
        scatter = _scatter(units[upright], area[upright]) - _scatter(units[level], area[level])
        found = np.linalg.eigh(scatter)[1][:, 0]
        up = found if found @ up > 0 else -found
    return np.array([0.0, 0.0, 1.0]) if up[2] > np.cos(np.radians(_IS_Z_DEG)) else np.asarray(up)


def _scatter(units: Float, weights: Float) -> Float:
    return np.asarray((units.T * weights) @ units)
