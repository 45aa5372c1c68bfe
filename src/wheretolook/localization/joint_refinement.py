"""Refines the pose of a rig whose views' poses to one another are known to some accuracy only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float
from wheretolook.localization.rig import Look

STEPS = 20
SMALL = 1e-9  # a step of the parameters, in metres and radians, below which the pose is found


def refine_with_turns(
    looks: Sequence[Look],
    points: Sequence[Float],
    inliers: Sequence[NDArray[np.bool_]],
    rig_from_world: Float,
    cams_from_world: Float,
    noise_rad: float,
) -> tuple[Float, Float]:
    """The rig's pose (3, 4) and its looks' poses (N, 3, 4) that explain the inliers best.

    Each look may have turned otherwise than told, about its centre: by a small rotation of which one standard deviation
    about each axis is `noise_rad`, a prior that is worth as much as a keypoint's error of one pixel. Gauss-Newton on
    the rig's pose and the looks' turns, with Cauchy's weights (one pixel) on the keypoints. Turns of the looks are as
    left by an earlier call, in `cams_from_world`; points (M, 3) m and masks (M,) are of each look.
    """
    from scipy.spatial.transform import Rotation

    mounts = [np.asarray(look.cam_from_rig, dtype=np.float64) for look in looks]
    n = len(looks)
    rig = np.array(rig_from_world)
    turns = np.stack([cams_from_world[k, :, :3] @ rig[:, :3].T @ mounts[k][:, :3].T for k in range(n)])
    for _ in range(STEPS):
        normal = np.zeros((6 + 3 * n, 6 + 3 * n))
        right = np.zeros(6 + 3 * n)
        for k, look in enumerate(looks):
            own = slice(6 + 3 * k, 9 + 3 * k)
            normal[own, own] += np.eye(3) / noise_rad**2
            right[own] -= Rotation.from_matrix(turns[k]).as_rotvec() / noise_rad**2
            if not inliers[k].any():
                continue
            in_rig = points[k][inliers[k]] @ rig[:, :3].T + rig[:, 3]
            mounted = in_rig @ mounts[k][:, :3].T + mounts[k][:, 3]
            there = mounted @ turns[k].T
            error = look.camera.project(there) - look.pixels[inliers[k]]
            by_point = _derivative(look, there)
            # world to rig is perturbed on the left, (turn, shift); a look's turn on the left, too
            by_rig = by_point @ turns[k] @ mounts[k][:, :3]
            jacobian = np.concatenate([by_rig @ -_skew(in_rig), by_rig, by_point @ -_skew(there)], axis=2)
            weight = 1 / (1 + (error**2).sum(1))
            columns = np.r_[0:6, own]
            normal[np.ix_(columns, columns)] += np.einsum("m,mij,mik->jk", weight, jacobian, jacobian)
            right[columns] -= np.einsum("m,mij,mi->j", weight, jacobian, error)
        step = np.linalg.lstsq(normal, right, rcond=None)[0]
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        rig = np.concatenate([turn @ rig[:, :3], (turn @ rig[:, 3] + step[3:6])[:, None]], axis=1)
        turns = np.stack([Rotation.from_rotvec(step[6 + 3 * k : 9 + 3 * k]).as_matrix() @ turns[k] for k in range(n)])
        if np.abs(step).max() < SMALL:
            break
    cams = [
        np.concatenate([turn @ m[:, :3] @ rig[:, :3], (turn @ (m[:, :3] @ rig[:, 3] + m[:, 3]))[:, None]], axis=1)
        for turn, m in zip(turns, mounts, strict=True)
    ]
    return rig, np.stack(cams)


def _derivative(look: Look, points_cam: Float) -> Float:
    """Of pixels by points (M, 3) in the camera's frame, (M, 2, 3): central differences, so that any camera will do."""
    size = 1e-6 * np.maximum(1.0, np.linalg.norm(points_cam, axis=1))[:, None]
    columns = []
    for axis in np.eye(3):
        ahead = look.camera.project(points_cam + size * axis)
        behind = look.camera.project(points_cam - size * axis)
        columns.append((ahead - behind) / (2 * size))
    return np.stack(columns, axis=2)


def _skew(vectors: Float) -> Float:
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([np.stack([zero, -z, y], 1), np.stack([z, zero, -x], 1), np.stack([-y, x, zero], 1)], 1)
