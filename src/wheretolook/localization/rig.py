"""What one view of a rig matched, and rigs of views that only turn."""

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
    """What one view of a rig matched."""

    cam_from_rig: Float  # (3, 4) metres
    pixels: Float  # (M, 2) of its image
    rows: NDArray[np.int64]  # (M,) of the landmarks
    camera: Camera


def turned_looks(turns: ArrayLike, matches: Sequence[tuple[Float, NDArray[np.int64]]], camera: Camera) -> list[Look]:
    """Looks of a camera that turned about its centre, by rotations `cam_from_rig` (N, 3, 3) and pixels and rows each.

    Raises a PoseError if these are no rotations.
    """
    rotations = np.asarray(turns, dtype=np.float64)
    if rotations.ndim != 3 or rotations.shape[1:] != (3, 3) or len(rotations) != len(matches):
        raise PoseError("turns are one rotation (3, 3) for each look", value=rotations.shape)
    at_rig = np.zeros((len(rotations), 3, 1))
    poses = np.concatenate([rotations, at_rig], axis=2)
    return [Look(pose, pixels, rows, camera) for pose, (pixels, rows) in zip(poses, matches, strict=True)]


def rig_of(cam_from_world: ArrayLike, tolerance_m: float = 1e-6) -> Float:
    """cam_from_rig (N, 3, 4) of views (N, 3, 4) of one place; the rig's axes are those of the first.

    Raises a PoseError if the views lie further from the first than the tolerance.
    """
    poses = np.asarray(cam_from_world, dtype=np.float64)
    apart = np.linalg.norm(camera_centers(poses) - camera_centers(poses[:1]), axis=1)
    if apart.max() > tolerance_m:
        fix = "Give views that only turn, or a rig's poses to one another."
        raise PoseError("these looks are not of one place", value=f"{apart.max():.3g} m apart", fix=fix)
    rotations = poses[:, :, :3] @ poses[0, :, :3].T
    return np.concatenate([rotations, np.zeros((len(poses), 3, 1))], axis=2)


def check_looks(looks: Sequence[Look]) -> None:
    """Raise a PoseError if there is no look, one's pose in the rig is not rigid, or its pixels and rows do not fit."""
    if not looks:
        raise PoseError("there is no look to localize", value=0)
    for number, look in enumerate(looks):
        mount = np.asarray(look.cam_from_rig, dtype=np.float64)
        turn = mount[:, :3] if mount.shape == (3, 4) else np.zeros((3, 3))
        rigid = (
            np.isfinite(mount).all() and np.allclose(turn @ turn.T, np.eye(3), atol=1e-6) and np.linalg.det(turn) > 0
        )
        if not rigid:
            fix = "Give a rotation (determinant 1) and a translation in metres."
            raise PoseError(f"the turn of look {number} is no rotation", value=mount.tolist(), fix=fix)
        if np.shape(look.pixels) != (len(look.rows), 2):
            value = (np.shape(look.pixels), len(look.rows))
            raise PoseError(f"look {number} needs a pixel (x, y) for each row of a landmark", value=value)
