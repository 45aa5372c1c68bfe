"""Localize views on a robot, against the descriptors in a folder of `wheretolook export --localize`.

Needs NumPy, SciPy and PoseLib, neither PyTorch nor COLMAP: `pip install numpy scipy poselib` on the robot. In the folder:

    from wheretolook_localization import RobotLocalizer

    localizer = RobotLocalizer("FOLDER")
    pose = localizer.localize([(pixels, descriptors)])[0]                # of one image
    pose = localizer.localize([view, other], turns=cam_from_rig)[0]     # of several from one location
    pose.cam_from_world, pose.probability

Pixel (0.5, 0.5) is the centre of the top-left pixel. Descriptors are RootSIFT times 512, as COLMAP stores them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import Float
from wheretolook.localization.confidence import ACCURACY, Accuracy, probabilities
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.estimation import PoseEstimator
from wheretolook.localization.guided_matching import Candidates
from wheretolook.localization.rig import Look
from wheretolook.localization.rig_localization import JointLocalizer

GROUP = 32  # landmarks; the best groups are selected first, and in them the best landmarks
NEAREST = 16  # landmarks of each keypoint
BLOCK = 256  # keypoints compared at a time
TURN_NOISE_DEG = 0.2  # of given rotations, one standard deviation about each axis


@dataclass(frozen=True, eq=False)
class RobotPose:
    """A pose hypothesis: of the rig, which for a single image is the camera."""

    cam_from_world: Float  # (3, 4) in the map's own frame and unit
    probability: float  # that it is within the accuracy
    n_inliers: int
    turn_error_deg: float = 0.0  # largest error of the given rotations if the images contradict them


class RobotLocalizer:
    """Localizes views in the map of an exported folder. Raises OSError or ValueError if a file cannot be used."""

    def __init__(self, folder: str | Path) -> None:
        folder = Path(folder)
        about = json.loads((folder / "robot.json").read_text(encoding="utf-8"))
        frame, camera = about["world_from_map"], about["camera"]
        self._scale = float(frame["scale"])  # metres in a unit of the map
        self._rotation = np.array(frame["rotation"], dtype=np.float64).reshape(3, 3)
        self._translation = np.array(frame["translation"], dtype=np.float64)
        centre = camera["cx"], camera["cy"]
        size = int(camera["width"]), int(camera["height"])
        self.camera = PinholeCamera(*size, camera["fx"], camera["fy"], centre)
        with np.load(folder / "landmarks.npz", allow_pickle=False) as stored:
            points = stored["points"]
        descriptors = np.load(folder / "descriptors.npy", allow_pickle=False)
        if descriptors.shape != (len(points), 128) or descriptors.dtype != np.uint8:
            raise ValueError(f"{folder}: descriptors and landmarks are of different exports. Export again.")
        padded = -(-max(len(points), NEAREST * GROUP) // GROUP) * GROUP
        self._n_landmarks = len(points)
        self._descriptors = np.zeros((128, padded), dtype=np.float32)
        self._descriptors[:, : len(points)] = descriptors.T
        self._config = LocalizerConfig(method="hypotheses")
        self._localizer = JointLocalizer(PoseEstimator(points, self._config), TURN_NOISE_DEG, check_turns=True)

    def localize(
        self,
        views: Sequence[tuple[ArrayLike, ArrayLike]],
        turns: ArrayLike | None = None,
        accuracy: Accuracy = ACCURACY,
    ) -> list[RobotPose]:
        """Localize one view or several from one location; returns the best pose and its rivals, empty if there is none.

        Args:
            views: pixels (K, 2) and descriptors (K, 128) uint8 of the keypoints of each.
            turns: rotations `cam_from_rig` (N, 3, 3) of several views.
            accuracy: limits in metres and degrees that the probability refers to.
        """
        if (turns is None and len(views) != 1) or not views:
            raise ValueError("several views are localized together by their rotations: give turns")
        rotations = np.eye(3)[None] if turns is None else np.asarray(turns, dtype=np.float64)
        if rotations.shape != (len(views), 3, 3):
            raise ValueError(f"turns must be one rotation for each view, ({len(views)}, 3, 3), not {rotations.shape}")
        poses = np.pad(rotations, ((0, 0), (0, 0), (0, 1)))
        result = self._localizer.localize([self._look(*view, pose) for view, pose in zip(views, poses, strict=True)])
        if result.rig_from_world is None:
            return []
        found = zip((result, *result.rivals), probabilities(result, accuracy), strict=True)
        return [
            RobotPose(self._in_map(pose.rig_from_world), float(probability), pose.n_inliers, result.turn_error_deg)
            for pose, probability in found
            if pose.rig_from_world is not None
        ]

    def nearest(self, descriptors: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Find the nearest landmarks of descriptors (K, 128): rows and squared distances, ascending, (K, NEAREST)."""
        parts = [self._nearest(descriptors[row : row + BLOCK]) for row in range(0, len(descriptors), BLOCK)]
        return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])

    def _nearest(self, descriptors: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        product = descriptors.astype(np.float32) @ self._descriptors  # exact: whole numbers below 2^24
        product[:, self._n_landmarks :] = -(2.0**28)
        groups = product.reshape(len(product), GROUP, -1)
        best = np.argpartition(-groups.max(axis=1), NEAREST - 1, axis=1)[:, :NEAREST]
        rows = (best[:, None] + np.arange(GROUP)[:, None] * groups.shape[2]).reshape(len(product), -1)
        values = np.take_along_axis(product, rows, axis=1)
        order = np.argpartition(-values, NEAREST - 1, axis=1)[:, :NEAREST]
        order = np.take_along_axis(order, np.argsort(-np.take_along_axis(values, order, 1), axis=1), 1)
        squared = np.maximum(2 * (512**2 - np.take_along_axis(values, order, 1)), 0)
        return np.take_along_axis(rows, order, 1), squared

    def _look(self, pixels: ArrayLike, descriptors: ArrayLike, cam_from_rig: Float) -> Look:
        """Match a view's keypoints with the map: Lowe's ratio test, and each landmark's nearest keypoint."""
        at, described = np.asarray(pixels, dtype=np.float64), np.asarray(descriptors)
        if at.shape != (len(described), 2) or described.shape[1:] != (128,) or described.dtype != np.uint8:
            raise ValueError(f"pixels (K, 2) and descriptors (K, 128) uint8, not {at.shape} and {described.shape}")
        none: NDArray[Any] = np.zeros(0, dtype=np.int64)
        if len(at) == 0 or self._n_landmarks < 2:
            return Look(cam_from_rig, at[:0], none, self.camera, Candidates(none, at[:0], none, none))
        near, squared = self.nearest(described)
        keypoints = np.flatnonzero(squared[:, 0] < self._config.max_ratio**2 * squared[:, 1])
        landmarks = near[keypoints, 0]
        order = np.lexsort((keypoints, squared[keypoints, 0], landmarks))
        unique = np.sort(order[np.unique(landmarks[order], return_index=True)[1]])
        matches: Any = SimpleNamespace(near=near, squared=squared)
        candidates = Candidates.of(at, matches)
        return Look(cam_from_rig, at[keypoints[unique]], landmarks[unique], self.camera, candidates)

    def _in_map(self, pose: Float) -> Float:
        """Transform a pose (3, 4) of the world, in metres, to the map's own frame and unit."""
        moved = (pose[:, :3] @ self._translation + pose[:, 3]) / self._scale
        return np.column_stack([pose[:, :3] @ self._rotation, moved])
