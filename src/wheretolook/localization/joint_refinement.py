"""Refines the pose of a rig together with the rotations of its views, which are known up to noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float, compose_poses, transform
from wheretolook.localization.rig import Look

MAX_STEPS = 20
MIN_STEP = 1e-9  # change of the parameters, in metres and radians, at which the iteration stops


def refine_rotations(
    looks: Sequence[Look],
    points: Sequence[Float],
    inliers: Sequence[NDArray[np.bool_]],
    rig_from_world: Float,
    cams_from_world: Float,
    noise_rad: float,
) -> tuple[Float, Float]:
    """Refine the rig's pose (3, 4) and its views' poses (N, 3, 4) on the inliers.

    Gauss-Newton on the rig's pose and one small rotation of each view about its centre, with Cauchy weights (one pixel)
    on the keypoints and a quadratic prior on the rotations, whose standard deviation about each axis is `noise_rad`.
    Rotations start as in `cams_from_world`; points (M, 3) m and masks (M,) are given for each view.
    """
    from scipy.spatial.transform import Rotation

    cam_from_rig = np.stack([look.cam_from_rig for look in looks])
    rig = rig_from_world
    turns = cams_from_world[:, :, :3] @ rig[:, :3].T @ cam_from_rig[:, :, :3].swapaxes(1, 2)
    for _ in range(MAX_STEPS):
        step = _solve(looks, points, inliers, rig, turns, noise_rad)
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        rig = compose_poses(np.column_stack([turn, step[3:6]]), rig)
        turns = Rotation.from_rotvec(step[6:].reshape(-1, 3)).as_matrix() @ turns
        if np.abs(step).max() < MIN_STEP:
            break
    return rig, turns @ compose_poses(cam_from_rig, rig)


def _solve(
    looks: Sequence[Look],
    points: Sequence[Float],
    inliers: Sequence[NDArray[np.bool_]],
    rig: Float,
    turns: Float,
    noise_rad: float,
) -> Float:
    """Gauss-Newton step (6 + 3 N,): left perturbations of rig_from_world (rotation, translation), then of rotations."""
    from scipy.spatial.transform import Rotation

    normal = np.zeros((6 + 3 * len(looks), 6 + 3 * len(looks)))
    right = np.zeros(len(normal))
    for k, look in enumerate(looks):
        columns_of_turn = slice(6 + 3 * k, 9 + 3 * k)
        normal[columns_of_turn, columns_of_turn] += np.eye(3) / noise_rad**2
        right[columns_of_turn] -= Rotation.from_matrix(turns[k]).as_rotvec() / noise_rad**2
        if not inliers[k].any():
            continue
        in_rig = transform(rig, points[k][inliers[k]])
        in_camera = transform(look.cam_from_rig, in_rig) @ turns[k].T
        error = look.camera.project(in_camera) - look.pixels[inliers[k]]
        by_point = _projection_jacobian(look, in_camera)
        by_rig = by_point @ turns[k] @ look.cam_from_rig[:, :3]
        # the derivative of a rotated point is the cross product with it
        by_rotations = np.cross(in_rig[:, None], by_rig), np.cross(in_camera[:, None], by_point)
        jacobian = np.concatenate([by_rotations[0], by_rig, by_rotations[1]], axis=2)
        weight = 1 / (1 + (error**2).sum(1))
        columns = np.r_[0:6, columns_of_turn]
        normal[np.ix_(columns, columns)] += np.einsum("m,mij,mik->jk", weight, jacobian, jacobian)
        right[columns] -= np.einsum("m,mij,mi->j", weight, jacobian, error)
    return np.linalg.lstsq(normal, right, rcond=None)[0]


def _projection_jacobian(look: Look, points_cam: Float) -> Float:
    """Derivative (M, 2, 3) of pixels by points (M, 3) in the camera's frame: central differences, for any camera."""
    size = 1e-6 * np.maximum(1.0, np.linalg.norm(points_cam, axis=1))[:, None]
    columns = []
    for axis in np.eye(3):
        ahead = look.camera.project(points_cam + size * axis)
        behind = look.camera.project(points_cam - size * axis)
        columns.append((ahead - behind) / (2 * size))
    return np.stack(columns, axis=2)
