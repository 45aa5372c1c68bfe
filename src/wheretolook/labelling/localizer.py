"""Global localization of an image against a map of landmarks, without a prior on its pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.features.extraction import KeypointExtractor
from wheretolook.features.keypoints import ExtractorConfig, Keypoints, quantize_descriptors
from wheretolook.features.matching import DescriptorMatcher, Matches, match
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float
from wheretolook.labelling.config import LocalizerConfig
from wheretolook.labelling.estimation import PoseEstimator
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.utils.errors import MapError
from wheretolook.viewpoints.table import LOCALIZED, NO_POSE, TOO_FEW_MATCHES


@dataclass(frozen=True, eq=False)
class Localization:
    """Result of localizing one image.

    Attributes:
        status: "localized", "too_few_matches" or "no_pose".
        cam_from_world: (3, 4) estimated pose, None if RANSAC found none. A pose with too few inliers is kept, but its
            status is "no_pose".
        n_matches: number of 2D-3D matches.
        inlier_rows: (I,) rows of the landmarks that were matched and agree with the pose.
        matched_rows: (M,) rows of all landmarks that were matched, whatever the status.
        matched_pixels: (M, 2) float32, where in the image each of them was.
    """

    status: str
    cam_from_world: Float | None
    n_matches: int
    inlier_rows: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    matched_rows: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    matched_pixels: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 2), dtype=np.float32))


class Localizer:
    """Localizes images against landmarks (paper, Sec. 3.3 "Self-supervision").

    Keypoints are extracted and matched to the landmarks' mean descriptors with Lowe's ratio test; PoseLib estimates the
    pose by P3P in LO-RANSAC and refines it on the inliers. The extractor must be what the map was made with; it and
    matching run on the device, "cpu" or a CUDA device. Raises MapError if the landmarks have no descriptors.
    """

    def __init__(
        self,
        landmarks: Landmarks,
        camera: Camera,
        config: LocalizerConfig | None = None,
        extractor: ExtractorConfig | None = None,
        device: str = "cpu",
    ) -> None:
        if landmarks.descriptors is None:
            raise MapError("landmarks without descriptors cannot be matched", fix="Build the map with its database.")
        self.landmarks, self.config = landmarks, config or LocalizerConfig()
        self.extractor = KeypointExtractor(extractor, device)
        self._matcher = DescriptorMatcher(landmarks.descriptors, device)
        self._camera, self._estimator = camera, PoseEstimator(landmarks.points, self.config)

    def localize(self, rgb: NDArray[np.uint8]) -> Localization:
        """Localize one image (H, W, 3) uint8."""
        keypoints = self.extractor.extract(rgb)
        return self.estimate(keypoints, *self.match([keypoints])[0])

    def extract(self, images: Sequence[NDArray[np.uint8]]) -> list[Keypoints]:
        """Step 1: keypoints of images, each (H, W, 3) uint8 and all of one size."""
        return self.extractor.extract_batch(images)

    def match(self, keypoints: Sequence[Keypoints]) -> list[Matches]:
        """Step 2: 2D-3D matches of several images at once; those of one image do not depend on the others."""
        descriptors = [quantize_descriptors(of_image.descriptors) for of_image in keypoints]
        return match(self._matcher, descriptors, self.config.max_ratio)

    def estimate(
        self,
        keypoints: Keypoints,
        keypoint_rows: NDArray[np.int64],
        landmark_rows: NDArray[np.int64],
        camera: Camera | None = None,
    ) -> Localization:
        """Step 3: the pose of one image from its matches, rows (M,) of its keypoints and rows (M,) of the landmarks.

        The image is of the localizer's camera, or of the one given.
        """
        n_matches, matched_pixels = len(keypoint_rows), keypoints.pixels[keypoint_rows]
        matched: dict[str, Any] = {"matched_rows": landmark_rows, "matched_pixels": matched_pixels}
        if n_matches < self.config.min_matches:
            return Localization(TOO_FEW_MATCHES, None, n_matches, **matched)
        found = self._estimator.estimate(matched_pixels, landmark_rows, camera or self._camera)
        if found is None:
            return Localization(NO_POSE, None, n_matches, **matched)
        cam_from_world, inliers = found
        status = LOCALIZED if inliers.sum() >= self.config.min_inliers else NO_POSE
        return Localization(status, cam_from_world, n_matches, landmark_rows[inliers], **matched)
