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

Pixel (0.5, 0.5) is the centre of the top-left pixel. Descriptors are RootSIFT times 512, as COLMAP stores them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.dataset.config import ACCURACY, Accuracy, checked_accuracy
from wheretolook.features.extractor import quantize_descriptors
from wheretolook.features.matches import has_twins, match
from wheretolook.features.opencv_sift import RootSift
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import (
    Float,
    camera_centers,
    compose_poses,
    invert_poses,
    pose_error,
    rotation_angle_deg,
)
from wheretolook.geometry.similarity import Similarity
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.estimation import PoseEstimator, SingleViewPoses
from wheretolook.localization.missing import ExpectedLandmarks
from wheretolook.localization.rig import IDENTITY, Look, PosePrior, checked_turns, matches_among
from wheretolook.localization.rig_localization import (
    POSES_OF_A_VIEW,
    POSES_OF_AN_IMAGE,
    JointLocalization,
    JointLocalizer,
)
from wheretolook.looks.next_look import DirectionScorer, NextLook, NextLookSelector
from wheretolook.robot.wheretolook_robot import read_description
from wheretolook.utils.errors import ConfigError

GROUP = 32  # landmarks; the best groups are selected first, and in them the best landmarks
NEAREST = 16  # landmarks of each keypoint


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
    def status(self) -> str:
        """As of `JointLocalization`: "contradicted" if the images contradict the given rotations."""
        return self.joint.status

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

    def __init__(self, folder: str | Path, turn_noise_deg: float = 0.2, in_world: bool = False) -> None:
        folder = Path(folder)
        about = read_description(folder)
        self._world_from_map = Similarity(1.0, np.eye(3), np.zeros(3))
        if not in_world:
            frame = about["world_from_map"]
            rotation = np.array(frame["rotation"])
            self._world_from_map = Similarity(float(frame["scale"]), rotation, np.array(frame["translation"]))
        camera = about["camera"]
        centre = camera["cx"], camera["cy"]
        width, height = int(camera["width"]), int(camera["height"])
        self.camera = PinholeCamera(width, height, camera["fx"], camera["fy"], centre)
        with np.load(folder / "landmarks.npz", allow_pickle=False) as stored:
            points = stored["points"]
            attributes = stored["attributes"]
            directions = stored["directions"]
        distance = attributes[:, about["map_attributes"].index("mapped_distance")]
        expected = ExpectedLandmarks.of(points, directions, attributes, about["map_attributes"])
        if "descriptors.npy" not in about["files"]:
            raise ValueError(f"{folder}: exported without descriptors. Export again with --localize.")
        if "calibration" not in about:
            raise ValueError(f"{folder}: exported by an earlier version, without calibration. Export again.")
        descriptors = np.load(folder / "descriptors.npy", allow_pickle=False)
        padded = -(-max(len(points), NEAREST * GROUP) // GROUP) * GROUP
        self.n_landmarks = len(points)
        self._descriptors = np.zeros((128, padded), dtype=np.float32)
        self._descriptors[:, : len(points)] = descriptors.T
        self._twins = descriptors if has_twins(self, descriptors, points) else None
        self._config = LocalizerConfig(method="hypotheses")
        estimator = PoseEstimator(points, self._config, about["calibration"] is not None)
        self._localizer = JointLocalizer(estimator, turn_noise_deg, True, expected)
        self._points = points
        self._mapping_distance_m = np.exp(distance)
        self._mean_scores = np.load(folder / "mean_scores.npy", allow_pickle=False)
        self._sift: RootSift | None = None

    def extract(self, grey: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Extract keypoints of a grey image (H, W) uint8: pixels (K, 2), descriptors (K, 128). Needs OpenCV.

        An image with more pixels across than the map's camera has is reduced to that size first.
        """
        if grey.ndim != 2 or grey.dtype != np.uint8 or grey.size == 0:
            raise ValueError(f"a grey image is an array (H, W) uint8, not {grey.shape} {grey.dtype}")
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
        if 1 / 1.5 < ratio < 1.5:
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
        n = described.size // 128
        if (
            at.shape != (n, 2)
            or described.shape != (n, 128)
            or described.dtype != np.uint8
            or not np.isfinite(at).all()
        ):
            problem = "finite pixels (K, 2) and descriptors (K, 128) uint8"
            raise ValueError(f"{problem}, not {at.shape} and {described.shape} {described.dtype}")
        (matches,) = match(self, [described], self._config.max_ratio, NEAREST, self._twins)
        look = Look.of(at, matches, camera or self.camera)
        near: SingleViewPoses = ()
        if prior is not None:
            rough = PosePrior.of(prior, self._world_from_map)
            allowed = rough.allows(self._points, self._mapping_distance_m, look.camera)
            of_prior = Look.of(at, matches_among(matches, allowed, self._config.max_ratio, self._twins), look.camera)
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
        poses = IDENTITY[None] if turns is None else checked_turns(turns, len(views))
        looks = [replace(view.look, cam_from_rig=pose) for view, pose in zip(views, poses, strict=True)]
        count = POSES_OF_A_VIEW if len(views) > 1 else POSES_OF_AN_IMAGE
        joint = self._localizer.localize(looks, [view.poses[:count] + view.near_prior for view in views])
        found = zip((joint, *joint.rivals), joint.probabilities(limits), strict=True)
        to_map = self._world_from_map.inverse.apply_to_poses
        in_map = []
        for pose, probability in found:
            if pose.rig_from_world is not None:
                cam_from_map = to_map(pose.rig_from_world)
                in_map.append(RobotPose(cam_from_map, float(probability), pose.n_inliers, self._covariance(pose)))
        return RobotLocalization(joint, tuple(in_map))

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
        return NextLookSelector(scorer, self._mean_scores).select(result.joint, up, pitch_deg, pan_deg)

    def nearest(
        self, descriptors: NDArray[np.uint8], count: int = NEAREST
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Find the nearest landmarks of descriptors (K, 128): rows and squared distances, ascending, (K, count)."""
        parts = [self._nearest(descriptors[row : row + 256], count) for row in range(0, len(descriptors), 256)]
        return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])

    def _nearest(self, descriptors: NDArray[np.uint8], count: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        product = descriptors.astype(np.float32) @ self._descriptors  # exact: whole numbers below 2^24
        product[:, self.n_landmarks :] = -(2.0**28)
        groups = product.reshape(len(product), GROUP, -1)
        best = np.argpartition(-groups.max(axis=1), count - 1, axis=1)[:, :count]
        rows = (best[:, None] + np.arange(GROUP)[:, None] * groups.shape[2]).reshape(len(product), -1)
        values = np.take_along_axis(product, rows, axis=1)
        order = np.argpartition(-values, count - 1, axis=1)[:, :count]
        order = np.take_along_axis(order, np.argsort(-np.take_along_axis(values, order, 1), axis=1), 1)
        squared = np.maximum(2 * (512**2 - np.take_along_axis(values, order, 1)), 0)
        return np.take_along_axis(rows, order, 1), squared

    def _covariance(self, pose: JointLocalization) -> Float:
        """Transform the covariance of a pose to the map's own frame and unit."""
        if not np.isfinite(pose.covariance).all():
            return pose.covariance
        to_map = np.kron(np.diag([1 / self._world_from_map.scale, 1]), self._world_from_map.rotation.T)
        return to_map @ pose.covariance @ to_map.T


@dataclass(frozen=True, eq=False)
class SequenceResult:
    """The pose of the last image."""

    localization: RobotLocalization  # its rig has the axes of the last image's camera
    n_views: int  # localized jointly
    contradiction: str = ""  # between the odometry and the images

    @property
    def reason(self) -> str:
        """Say why the pose is not more probable."""
        joint = self.localization.joint
        if not self.localization.poses:
            return f"lost: no pose from {joint.n_matches} matches with the map"
        support = f"{joint.n_inliers} of {joint.n_matches} matches are inliers, {len(joint.rivals)} rival poses"
        return f"lost: probability {self.localization.probability:.3f}, {support}"


class ImageSequence:
    """Keeps the last views from about one location, until an image is localized by itself.

    Args:
        localizer: of the map.
        confidence: probability from which on an image needs no other views.
        accuracy: limits in metres and degrees that probabilities refer to.
        max_views: localized jointly.
        max_move_m: distance between the locations of views that are localized jointly.

    Raises ConfigError unless 0 < confidence <= 1 and at least one view is localized.
    """

    def __init__(
        self,
        localizer: RobotLocalizer,
        confidence: float = 0.95,
        accuracy: Accuracy = ACCURACY,
        max_views: int = 4,
        max_move_m: float = 0.3,
    ) -> None:
        if not 0 < confidence <= 1:
            raise ConfigError("a confidence is a probability", value=confidence, fix="Give one above 0, such as 0.95.")
        if max_views < 1:
            raise ConfigError("at least one view is localized", value=max_views, fix="Give max_views from 1 on.")
        self.localizer = localizer
        self.confidence = confidence
        self.accuracy = accuracy
        self.max_views = max_views
        self.max_move_m = max_move_m
        self.reset()

    def reset(self) -> None:
        """Forget all earlier images."""
        self._kept: list[tuple[RobotView, Float]] = []
        self._confident: tuple[Float, Float] | None = None

    def add(self, view: RobotView, cam_from_odom: Float | None = None) -> SequenceResult:
        """Localize the next image, given the pose (3, 4) of its camera by odometry, in metres, if known."""
        alone = self.localizer.localize([view], accuracy=self.accuracy)
        if cam_from_odom is None:
            self.reset()
            return SequenceResult(alone, 1)
        others = [kept for kept in self._kept if self._joins(kept[1], cam_from_odom)]
        best = alone
        n_views = 1
        contradiction = ""
        if others and alone.probability < self.confidence:
            turns = np.stack([compose_poses(pose, invert_poses(cam_from_odom)) for _, pose in others])
            views = [view, *(kept for kept, _ in others)]
            joint = self.localizer.localize(views, np.concatenate([np.eye(3, 4)[None], turns]), self.accuracy)
            if joint.probability >= alone.probability:
                best = joint
                n_views = len(views)
                if joint.joint.turn_error_deg:
                    contradiction = f"odometry contradicts the images by {joint.joint.turn_error_deg:.1f} degrees"
        kept = [*others, (view, cam_from_odom)]
        self._kept = kept[max(len(kept) + 1 - self.max_views, 0) :]
        if best.probability >= self.confidence:
            pose = best.joint.rig_from_world
            assert pose is not None
            if self._confident is not None:
                contradiction = _contradiction(*self._confident, pose, cam_from_odom) or contradiction
            if contradiction:
                self._kept = self._kept[-1:]
            self._confident = pose, cam_from_odom
        return SequenceResult(best, n_views, contradiction)

    def _joins(self, earlier: Float, now: Float) -> bool:
        """Whether a camera pose is near enough to another, and looks elsewhere."""
        moved = np.linalg.norm(camera_centers(earlier) - camera_centers(now))
        return bool(moved <= self.max_move_m and rotation_angle_deg(earlier[:, :3], now[:, :3]) >= 20.0)


def _contradiction(map_before: Float, odom_before: Float, map_now: Float, odom_now: Float) -> str:
    """Describe by how much odometry and localization disagree on a motion.

    Empty if within 5 degrees, and 25 cm and a tenth of the distance.
    """
    now_from_before = compose_poses(odom_now, invert_poses(odom_before))
    error_m, error_deg = pose_error(compose_poses(now_from_before, map_before), map_now)
    distance = np.linalg.norm(camera_centers(odom_now) - camera_centers(odom_before))
    if error_m <= 0.25 + 0.1 * distance and error_deg <= 5.0:
        return ""
    return f"odometry contradicts the images by {error_m:.2f} m and {error_deg:.1f} degrees"
