"""Noisy odometry between consecutive views, which makes them parts of one camera rig."""

from __future__ import annotations

import numpy as np

from wheretolook.geometry.poses import Float, invert_poses, rotation_angle_deg


def noisy_steps(cam_from_world: Float, m_per_m: float, deg_per_deg: float, rng: np.random.Generator) -> Float:
    """Return steps (W - 1, 3, 4) between views (W, 3, 4) along a path: each camera from the next, with noise.

    The standard deviation of the translation is `m_per_m` metres along each axis per metre of the step, that of the
    rotation `deg_per_deg` degrees about each axis per degree.
    """
    from scipy.spatial.transform import Rotation

    steps = chained(cam_from_world[:-1], invert_poses(cam_from_world[1:]))
    metres = np.linalg.norm(steps[:, :, 3], axis=1, keepdims=True)
    radians = np.radians(rotation_angle_deg(steps[:, :, :3], np.eye(3)))[:, None]
    shift = m_per_m * metres * rng.normal(size=(len(steps), 3))
    rotation = Rotation.from_rotvec(deg_per_deg * radians * rng.normal(size=(len(steps), 3))).as_matrix()
    return np.concatenate([rotation @ steps[:, :, :3], (steps[:, :, 3] + shift)[..., None]], axis=2)


def rig_of_last(steps: Float, view: int, n: int) -> Float:
    """Return cam_from_rig (N, 3, 4) of a view and up to n - 1 views before it, newest first, given `noisy_steps`.

    The rig's frame is the camera of the view.
    """
    cam_from_rig: list[Float] = [np.eye(3, 4)]
    for step in steps[max(0, view - n + 1) : view][::-1]:
        cam_from_rig.append(chained(step, cam_from_rig[-1]))
    return np.stack(cam_from_rig)


def chained(a: Float, b: Float) -> Float:
    """Compose rigid transforms (..., 3, 4): first b, then a."""
    rotation = a[..., :3] @ b[..., :3]
    return np.concatenate([rotation, a[..., :3] @ b[..., 3:] + a[..., 3:]], axis=-1)
