"""Localize views on a robot, against the descriptors in a folder of `wheretolook export --localize`.

Needs NumPy, SciPy and PoseLib, neither PyTorch nor COLMAP: `pip install numpy scipy poselib` on the robot, and OpenCV
for `extract`. In the folder:

    from wheretolook_localization import RobotLocalizer
    from wheretolook_robot import RobotScorer

    localizer = RobotLocalizer("FOLDER")
    view = localizer.match(*localizer.extract(grey))
    result = localizer.localize([view])                                 # of one image
    result = localizer.localize([view, other], turns=cam_from_rig)      # of several from one location
    result.poses[0].cam_from_world, result.poses[0].probability
    localizer.next_look(result, RobotScorer("FOLDER")).cam_from_rig     # where to look if it is not probable enough

Pixel (0.5, 0.5) is the centre of the top-left pixel. Descriptors are RootSIFT times 512, as COLMAP stores them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.dataset.thresholds import ACCURACY, Accuracy, checked_accuracy
from wheretolook.features.descriptors import quantize_descriptors
from wheretolook.features.matches import Matches
from wheretolook.features.opencv_sift import RootSift
from wheretolook.geometry.camera import Camera, PinholeCamera
from wheretolook.geometry.poses import Float
from wheretolook.localization.confidence import probabilities
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.estimation import PoseEstimator
from wheretolook.localization.hypotheses import SingleViewPoses
from wheretolook.localization.prior import PosePrior, matches_among
from wheretolook.localization.rig import Candidates, Look
from wheretolook.localization.rig_localization import (
    POSES_OF_A_VIEW,
    POSES_OF_AN_IMAGE,
    JointLocalization,
    JointLocalizer,
)
from wheretolook.looks.next_look import DirectionScorer, NextLook, NextLookSelector

FORMAT_VERSION = 1  # of the folder, as in export.py
GROUP = 32  # landmarks; the best groups are selected first, and in them the best landmarks
NEAREST = 16  # landmarks of each keypoint
BLOCK = 256  # keypoints compared at a time
MAX_FOCAL_RATIO = 1.5  # between a camera and that of the folder
TURN_NOISE_DEG = 0.2  # of given rotations, one standard deviation about each axis


@dataclass(frozen=True, eq=False)
class RobotPose:
    """A pose hypothesis: of the rig, which for a single image is the camera."""

    cam_from_world: Float  # (3, 4) in the map's own frame and unit
    probability: float  # that it is within the accuracy
    n_inliers: int
    covariance: Float  # (6, 6) of the position and of the orientation (rad) about the axes of the map


@dataclass(frozen=True, eq=False)
class RobotView:
    """The matches of an image with the map, and the poses that they support by themselves."""

    look: Look
    poses: SingleViewPoses
    near_prior: SingleViewPoses = ()


@dataclass(frozen=True, eq=False)
class RobotLocalization:
    """The result for one view or several from one location."""

    joint: JointLocalization
    poses: tuple[RobotPose, ...]  # the best and its rivals; empty if there is none

    @property
    def probability(self) -> float:
        """Probability of the best pose; 0 if there is none."""
        return self.poses[0].probability if self.poses else 0.0


class RobotLocalizer:
    """Localizes views in the map of an exported folder.

    Args:
        folder: as `wheretolook export --localize` wrote it.
        turn_noise_deg: one standard deviation, about each axis, of the rotations between views.
        in_world: poses and priors are in the world, metres with z up, instead of the map's own frame.

    Raises OSError or ValueError if a file cannot be used.
    """

    def __init__(self, folder: str | Path, turn_noise_deg: float = TURN_NOISE_DEG, in_world: bool = False) -> None:
        folder = Path(folder)
        about = json.loads((folder / "robot.json").read_text(encoding="utf-8"))
        if about.get("format_version") != FORMAT_VERSION:
            raise ValueError(f"{folder}: this program reads format {FORMAT_VERSION}. Export again.")
        identity: dict[str, Any] = {"scale": 1, "rotation": np.eye(3), "translation": np.zeros(3)}
        frame = identity if in_world else about["world_from_map"]
        camera = about["camera"]
        self._scale = float(frame["scale"])  # metres in a unit of the map
        self._rotation = np.array(frame["rotation"], dtype=np.float64).reshape(3, 3)
        self._translation = np.array(frame["translation"], dtype=np.float64)
        centre = camera["cx"], camera["cy"]
        size = int(camera["width"]), int(camera["height"])
        self.camera = PinholeCamera(*size, camera["fx"], camera["fy"], centre)
        with np.load(folder / "landmarks.npz", allow_pickle=False) as stored:
            points = stored["points"]
            distance = stored["attributes"][:, about["map_attributes"].index("mapped_distance")]
        descriptors = np.load(folder / "descriptors.npy", allow_pickle=False)
        if descriptors.shape != (len(points), 128) or descriptors.dtype != np.uint8:
            raise ValueError(f"{folder}: descriptors and landmarks are of different exports. Export again.")
        padded = -(-max(len(points), NEAREST * GROUP) // GROUP) * GROUP
        self._n_landmarks = len(points)
        self._descriptors = np.zeros((128, padded), dtype=np.float32)
        self._descriptors[:, : len(points)] = descriptors.T
        self._config = LocalizerConfig(method="hypotheses")
        self._localizer = JointLocalizer(PoseEstimator(points, self._config), turn_noise_deg, check_turns=True)
        self._points = points
        self._mapping_distance_m = np.exp(distance)
        scores = folder / "mean_scores.npy"
        self._mean_scores = np.load(scores, allow_pickle=False) if scores.is_file() else None
        self._sift: RootSift | None = None

    def extract(self, grey: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Extract keypoints of a grey image (H, W) uint8: pixels (K, 2), descriptors (K, 128). Needs OpenCV.

        An image with more pixels across than the map's camera has is reduced to that size first.
        """
        if self._sift is None:
            self._sift = RootSift()
        scale = self.camera.width / grey.shape[1]
        if scale < 1:
            import cv2

            grey = np.asarray(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
        keypoints = self._sift.extract(grey)
        return keypoints.pixels / np.float32(min(scale, 1)), quantize_descriptors(keypoints.descriptors)

    def difference(self, camera: PinholeCamera) -> str:
        """Describe how much the focal length of a camera differs from the folder's; empty if that hardly matters."""
        ratio = camera.fx / camera.width * self.camera.width / self.camera.fx
        if 1 / MAX_FOCAL_RATIO < ratio < MAX_FOCAL_RATIO:
            return ""
        return f"the focal length, relative to the width, is {ratio:.2f} times that of the map's camera"

    def match(
        self,
        pixels: ArrayLike,
        descriptors: ArrayLike,
        camera: PinholeCamera | None = None,
        prior: Sequence[float] | None = None,
    ) -> RobotView:
        """Match an image with the map.

        Args:
            pixels: (K, 2) of its keypoints.
            descriptors: (K, 128) uint8.
            camera: of the image; by default that of the folder.
            prior: rough x, y, z in the map, and perhaps the yaw of the camera in degrees: one more hypothesis.
        """
        at = np.asarray(pixels, dtype=np.float64)
        described = np.asarray(descriptors)
        if at.shape != (len(described), 2) or described.shape[1:] != (128,) or described.dtype != np.uint8:
            raise ValueError(f"pixels (K, 2) and descriptors (K, 128) uint8, not {at.shape} and {described.shape}")
        matches = self._matches(described)
        look = self._look(at, matches, camera or self.camera)
        near: SingleViewPoses = ()
        if prior is not None:
            location = self._scale * self._rotation @ np.asarray(prior[:3]) + self._translation
            yaw_deg = prior[3] if len(prior) > 3 else None
            rough = PosePrior((location[0], location[1], location[2]), yaw_deg)
            allowed = rough.allows(self._points, self._mapping_distance_m, look.camera)
            of_prior = self._look(at, matches_among(matches, allowed, self._config.max_ratio), look.camera)
            near = self._localizer.single_view_poses(of_prior, 1)
        return RobotView(look, self._localizer.single_view_poses(look, POSES_OF_AN_IMAGE), near)

    def localize(
        self, views: Sequence[RobotView], turns: ArrayLike | None = None, accuracy: Accuracy = ACCURACY
    ) -> RobotLocalization:
        """Localize one view or several from one location.

        Args:
            views: as by `match`.
            turns: rotations `cam_from_rig` (N, 3, 3) of several views, or poses (N, 3, 4) in metres.
            accuracy: limits in metres and degrees that the probability refers to.
        """
        limits = checked_accuracy(accuracy)
        if (turns is None and len(views) != 1) or not views:
            raise ValueError("several views are localized together by their rotations: give turns")
        poses = np.eye(3, 4)[None] if turns is None else np.asarray(turns, dtype=np.float64)
        if poses.shape not in ((len(views), 3, 3), (len(views), 3, 4)):
            raise ValueError(f"turns must be one rotation for each view, ({len(views)}, 3, 3), not {poses.shape}")
        if poses.shape[2] == 3:
            poses = np.pad(poses, ((0, 0), (0, 0), (0, 1)))
        looks = [replace(view.look, cam_from_rig=pose) for view, pose in zip(views, poses, strict=True)]
        count = POSES_OF_A_VIEW if len(views) > 1 else POSES_OF_AN_IMAGE
        joint = self._localizer.localize(looks, [view.poses[:count] + view.near_prior for view in views])
        found = zip((joint, *joint.rivals), probabilities(joint, limits), strict=True)
        return RobotLocalization(
            joint,
            tuple(
                RobotPose(self._in_map(pose.rig_from_world), float(probability), pose.n_inliers, self._covariance(pose))
                for pose, probability in found
                if pose.rig_from_world is not None
            ),
        )

    def next_look(
        self,
        result: RobotLocalization,
        scorer: DirectionScorer,
        pitch_deg: tuple[float, float] = (-45.0, 45.0),
        pan_deg: tuple[float, float] | None = None,
        up: ArrayLike | None = None,
    ) -> NextLook:
        """Select where a camera that turns in place looks next, as `NextLookSelector.select` with a `RobotScorer`.

        Raises ValueError if the folder is of another version, PlanningError if the limits leave no new view.
        """
        if self._mean_scores is None:
            raise ValueError("the folder has no mean_scores.npy. Export again.")
        return NextLookSelector(scorer, self._mean_scores).select(result.joint, up, pitch_deg, pan_deg)

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

    def _matches(self, descriptors: NDArray[np.uint8]) -> Matches:
        """Match descriptors (K, 128) with the map: Lowe's ratio test, and each landmark's nearest keypoint."""
        if len(descriptors) == 0 or self._n_landmarks < 2:
            return Matches.none(len(descriptors))
        near, squared = self.nearest(descriptors)
        keypoints = np.flatnonzero(squared[:, 0] < self._config.max_ratio**2 * squared[:, 1])
        landmarks = near[keypoints, 0]
        order = np.lexsort((keypoints, squared[keypoints, 0], landmarks))
        unique = np.sort(order[np.unique(landmarks[order], return_index=True)[1]])
        return Matches(keypoints[unique], landmarks[unique], near, squared)

    def _look(self, pixels: Float, matches: Matches, camera: Camera) -> Look:
        of_all = Candidates.of(pixels, matches)
        return Look(np.eye(3, 4), pixels[matches.keypoints], matches.landmarks, camera, of_all)

    def _covariance(self, pose: JointLocalization) -> Float:
        """Transform the covariance of a pose to the map's own frame and unit."""
        if not np.isfinite(pose.covariance).all():
            return pose.covariance
        to_map = np.kron(np.diag([1 / self._scale, 1]), self._rotation.T)
        return to_map @ pose.covariance @ to_map.T

    def _in_map(self, pose: Float) -> Float:
        """Transform a pose (3, 4) of the world, in metres, to the map's own frame and unit."""
        moved = (pose[:, :3] @ self._translation + pose[:, 3]) / self._scale
        return np.column_stack([pose[:, :3] @ self._rotation, moved])
