"""Global localization of an image against a map of landmarks, without a prior on its pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.dataset.viewpoint_table import LOCALIZED, NO_POSE, TOO_FEW_MATCHES
from wheretolook.features.config import ExtractorConfig
from wheretolook.features.extraction import KeypointExtractor
from wheretolook.features.keypoints import Keypoints
from wheretolook.features.matching import DescriptorMatcher, Matches, match
from wheretolook.features.registry import all_kinds, kind_of
from wheretolook.features.similarity import SimilarityMatcher
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.estimation import PoseEstimator
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.utils.errors import MapError

if TYPE_CHECKING:
    from wheretolook.localization.lightglue import LightGlueMatcher


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

    Keypoints are extracted and matched to the landmarks' mean descriptors, SIFT's with Lowe's ratio test, learned ones
    where both are each other's nearest; PoseLib estimates the pose by P3P in LO-RANSAC and refines it on the inliers.
    The extractor must be what the map was made with, and may be left out where nothing is extracted; it and matching
    run on the device, "cpu" or a CUDA device. `map_dir` is the folder of the map, which LightGlue needs
    (`LocalizerConfig.lightglue`). Raises MapError if the landmarks have no descriptors, or others than the extractor's.
    """

    def __init__(
        self,
        landmarks: Landmarks,
        camera: Camera,
        config: LocalizerConfig | None = None,
        extractor: ExtractorConfig | None = None,
        device: str = "cpu",
        map_dir: Path | None = None,
    ) -> None:
        if landmarks.descriptors is None:
            raise MapError("landmarks without descriptors cannot be matched", fix="Build the map with its database.")
        self.landmarks = landmarks
        self.config = config or LocalizerConfig()
        self.kind = all_kinds()[landmarks.features]
        if extractor is not None:
            self._refuse_other(extractor)
        self._extract_with = extractor
        self._device = device
        by_ratio = self.kind.in_bytes
        self._matcher = (DescriptorMatcher if by_ratio else SimilarityMatcher)(landmarks.descriptors, device)
        self._guided: LightGlueMatcher | None = None
        if self.config.lightglue:
            from wheretolook.localization.lightglue import LightGlueMatcher

            self._guided = LightGlueMatcher(landmarks, map_dir, self.config.lightglue, device)
        self._camera = camera
        self.estimator = PoseEstimator(landmarks.points, self.config)

    @cached_property
    def extractor(self) -> KeypointExtractor:
        """What finds keypoints in queries. Made when first asked for: keypoints may also be given."""
        config = self._extract_with or ExtractorConfig()
        self._refuse_other(config)
        return KeypointExtractor(config, self._device)

    def _refuse_other(self, extractor: ExtractorConfig) -> None:
        if kind_of(extractor.method) != self.kind:
            problem = f"the map's landmarks are described by {self.kind.name}: other keypoints match none of them"
            fix = "Map again with what queries are to have, --map.extractor.method."
            raise MapError(problem, value=extractor.method, fix=fix)

    def localize(self, rgb: NDArray[np.uint8]) -> Localization:
        """Localize one image (H, W, 3) uint8."""
        keypoints = self.extractor.extract(rgb)
        return self.estimate(keypoints, *self.match([keypoints])[0])

    def extract(self, images: Sequence[NDArray[np.uint8]]) -> list[Keypoints]:
        """Step 1: keypoints of images, each (H, W, 3) uint8 and all of one size."""
        return self.extractor.extract_batch(images)

    def match(self, keypoints: Sequence[Keypoints], camera: Camera | None = None) -> list[Matches]:
        """Step 2: 2D-3D matches of several images at once; those of one image do not depend on the others.

        The images are of the localizer's camera, or of the one given.
        """
        matches = self._match(keypoints)
        if self._guided is None:
            return matches
        seen_by = camera or self._camera
        n_images = self.config.lightglue_images
        size = (seen_by.width, seen_by.height)
        return [
            self._guided.match(of_image, size, rows, n_images)
            for of_image, (_, rows) in zip(keypoints, matches, strict=True)
        ]

    def _match(self, keypoints: Sequence[Keypoints]) -> list[Matches]:
        descriptors = [self.kind.store(of_image.descriptors) for of_image in keypoints]
        if isinstance(self._matcher, SimilarityMatcher):
            least = self.config.min_similarity
            return self._matcher.match(descriptors, self.kind.min_similarity if least is None else least)
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
        n_matches = len(keypoint_rows)
        matched_pixels = keypoints.pixels[keypoint_rows]
        matched: dict[str, Any] = {"matched_rows": landmark_rows, "matched_pixels": matched_pixels}
        if n_matches < self.config.min_matches:
            return Localization(TOO_FEW_MATCHES, None, n_matches, **matched)
        found = self.estimator.estimate(matched_pixels, landmark_rows, camera or self._camera)
        if found is None:
            return Localization(NO_POSE, None, n_matches, **matched)
        cam_from_world, inliers = found
        status = LOCALIZED if inliers.sum() >= self.config.min_inliers else NO_POSE
        return Localization(status, cam_from_world, n_matches, landmark_rows[inliers], **matched)
