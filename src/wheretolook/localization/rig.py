"""Matches of the views of a rig, and the poses of its views."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float, as_numbers, camera_centers, compose_poses, invert_poses, rigid_poses
from wheretolook.utils.errors import PoseError

if TYPE_CHECKING:
    from wheretolook.features.matches import Matches

IDENTITY: Float = np.eye(3, 4)

MAX_NEAREST_RATIO = 1.15
"""Maximum ratio of the descriptor distances to a candidate and to the nearest landmark of the map."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Landmarks whose descriptors are about as near to a keypoint's as the nearest of the map.

    Attributes:
        keypoints: (M,) rows of an image's keypoints.
        pixels: (M, 2) their pixels.
        landmarks: (M,) rows of their candidates.
        squared: (M,) squared distances of the descriptors.
    """

    keypoints: NDArray[np.int64]
    pixels: Float
    landmarks: NDArray[np.int64]
    squared: NDArray[np.float32]

    @classmethod
    def of(cls, pixels: Float, matches: Matches) -> Candidates:
        """Select from the nearest landmarks of keypoints at pixels (K, 2)."""
        near = matches.squared <= MAX_NEAREST_RATIO**2 * matches.squared[:, :1]
        keypoints = np.repeat(np.arange(len(near)), near.sum(1))
        return cls(keypoints, pixels[keypoints], matches.near[near], matches.squared[near])


@dataclass(frozen=True, eq=False)
class Look:
    """The matches of one view of a rig.

    Raises PoseError if the pose in the rig is not rigid, or pixels and rows differ in number.
    """

    cam_from_rig: Float  # (3, 4) metres
    pixels: Float  # (M, 2) in its image
    rows: NDArray[np.int64]  # (M,) of the landmarks
    camera: Camera
    candidates: Candidates | None = None  # for all its keypoints, if they are to be matched again under each hypothesis

    @classmethod
    def of(cls, pixels: Float, matches: Matches, camera: Camera, cam_from_rig: Float = IDENTITY) -> Look:
        """Combine the matches of an image with their candidates, from the pixels (K, 2) of all its keypoints."""
        at: Float = np.asarray(pixels, dtype=np.float64)
        candidates = Candidates.of(at, matches)
        return cls(cam_from_rig, at[matches.keypoints], matches.landmarks, camera, candidates)

    def __post_init__(self) -> None:
        rotation = self.cam_from_rig[:, :3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) or np.linalg.det(rotation) < 0:
            raise PoseError("the pose of a view in the rig is not rigid", value=self.cam_from_rig.tolist())
        if np.shape(self.pixels) != (len(self.rows), 2):
            value = (np.shape(self.pixels), len(self.rows))
            raise PoseError("a view needs a pixel (x, y) for each row of a landmark", value=value)


def checked_turns(turns: ArrayLike, n_views: int) -> Float:
    """Return rotations (N, 3, 3) or poses (N, 3, 4) of cameras in a rig as exactly rigid poses (N, 3, 4).

    Raises PoseError if one is not rigid, or there are more or fewer than views.
    """
    from scipy.spatial.transform import Rotation

    poses = as_numbers(turns)
    if poses.shape[1:] == (3, 3):
        poses = np.pad(poses, ((0, 0), (0, 0), (0, 1)))
    poses = rigid_poses(poses)
    if len(poses) != n_views:
        raise PoseError("each view needs a rotation", value=f"{len(poses)} rotations of {n_views} views")
    poses[:, :, :3] = Rotation.from_matrix(poses[:, :, :3]).as_matrix()  # of rounded numbers
    return poses


def rig_of(cam_from_world: Float) -> Float:
    """cam_from_rig (N, 3, 4) of views (N, 3, 4) from one location; the rig has the axes of the first view.

    Raises PoseError if a view is elsewhere than the first.
    """
    centers = camera_centers(cam_from_world)
    distance = np.linalg.norm(centers - centers[0], axis=1)
    if distance.max() > 1e-6:
        raise PoseError("these views are not from one location", value=f"{distance.max():.3g} m apart")
    cam_from_rig = compose_poses(cam_from_world, invert_poses(cam_from_world[0]))
    cam_from_rig[:, :, 3] = 0
    return cam_from_rig
