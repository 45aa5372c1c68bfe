"""How a camera moved from view to view, as odometry tells it: with it, views along a way are parts of one rig."""

from __future__ import annotations

import numpy as np

from wheretolook.geometry.poses import Float, invert_poses, rotation_angle_deg


def told_steps(cam_from_world: Float, m_per_m: float, deg_per_deg: float, rng: np.random.Generator) -> Float:
    """Steps (W - 1, 3, 4) between consecutive views (W, 3, 4) along a way: each view's camera from that of the next.

    Each is off by noise of its own: one standard deviation of the translation is `m_per_m` metres along each axis for
    every metre of the step, of the rotation `deg_per_deg` degrees about each axis for every degree.
    """
    from scipy.spatial.transform import Rotation

    steps = chained(cam_from_world[:-1], invert_poses(cam_from_world[1:]))
    metres = np.linalg.norm(steps[:, :, 3], axis=1, keepdims=True)
    radians = np.radians(rotation_angle_deg(steps[:, :, :3], np.eye(3)))[:, None]
    shift = m_per_m * metres * rng.normal(size=(len(steps), 3))
    turn = Rotation.from_rotvec(deg_per_deg * radians * rng.normal(size=(len(steps), 3))).as_matrix()
    return np.concatenate([turn @ steps[:, :, :3], (steps[:, :, 3] + shift)[..., None]], axis=2)


def rig_of_last(steps: Float, view: int, n: int) -> Float:
    """cam_from_rig (N, 3, 4) of a view along a way and up to n - 1 before it, the last first, by `told_steps`.

    The rig's frame is the view's own camera.
    """
    mounts: list[Float] = [np.eye(3, 4)]
    for step in steps[max(0, view - n + 1) : view][::-1]:
        mounts.append(chained(step, mounts[-1]))
    return np.stack(mounts)


def chained(a: Float, b: Float) -> Float:
    """Rigid transforms (..., 3, 4): first b, then a."""
    rotation = a[..., :3] @ b[..., :3]
    return np.concatenate([rotation, a[..., :3] @ b[..., 3:] + a[..., 3:]], axis=-1)
