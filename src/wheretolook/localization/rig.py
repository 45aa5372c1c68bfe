"""Matches of the views of a rig, and rigs whose views only rotate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.utils.errors import PoseError


@dataclass(frozen=True, eq=False)
class Look:
    """The matches of one view of a rig."""

    cam_from_rig: Float  # (3, 4) metres
    pixels: Float  # (M, 2) in its image
    rows: NDArray[np.int64]  # (M,) of the landmarks
    camera: Camera


def turned_looks(turns: ArrayLike, matches: Sequence[tuple[Float, NDArray[np.int64]]], camera: Camera) -> list[Look]:
    """Views of a camera rotated about its centre, from rotations `cam_from_rig` (N, 3, 3) and (pixels, rows) of each.

    Raises PoseError unless there is one rotation per view.
    """
    rotations = np.asarray(turns, dtype=np.float64)
    if rotations.ndim != 3 or rotations.shape[1:] != (3, 3) or len(rotations) != len(matches):
        raise PoseError("each view needs one rotation (3, 3)", value=rotations.shape)
    poses = np.concatenate([rotations, np.zeros((len(rotations), 3, 1))], axis=2)
    return [Look(pose, pixels, rows, camera) for pose, (pixels, rows) in zip(poses, matches, strict=True)]


def rig_of(cam_from_world: ArrayLike, tolerance_m: float = 1e-6) -> Float:
    """cam_from_rig (N, 3, 4) of views (N, 3, 4) from one location; the rig has the axes of the first view.

    Raises PoseError if a view is further from the first than the tolerance.
    """
    poses = np.asarray(cam_from_world, dtype=np.float64)
    distance = np.linalg.norm(camera_centers(poses) - camera_centers(poses[:1]), axis=1)
    if distance.max() > tolerance_m:
        raise PoseError("these views are not from one location", value=f"{distance.max():.3g} m apart")
    rotations = poses[:, :, :3] @ poses[0, :, :3].T
    return np.concatenate([rotations, np.zeros((len(poses), 3, 1))], axis=2)


def check_looks(looks: Sequence[Look]) -> None:
    """Raise PoseError if there is no view, a view's pose in the rig is not rigid, or its pixels and rows mismatch."""
    if not looks:
        raise PoseError("there is no view to localize", value=0)
    for number, look in enumerate(looks):
        pose = np.asarray(look.cam_from_rig, dtype=np.float64)
        rotation = pose[:, :3] if pose.shape == (3, 4) and np.isfinite(pose).all() else np.zeros((3, 3))
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) or np.linalg.det(rotation) < 0:
            raise PoseError(f"the pose of view {number} in the rig is not rigid", value=pose.tolist())
        if np.shape(look.pixels) != (len(look.rows), 2):
            value = (np.shape(look.pixels), len(look.rows))
            raise PoseError(f"view {number} needs a pixel (x, y) for each row of a landmark", value=value)
