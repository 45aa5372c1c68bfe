"""Localizes images globally against a map of landmarks, without a prior on the pose."""

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
        matched_rows: (M,) rows of all matched landmarks.
        matched_pixels: (M, 2) float32, their pixels in the image.
    """

    status: str
    cam_from_world: Float | None
    n_matches: int
    inlier_rows: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    matched_rows: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    matched_pixels: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 2), dtype=np.float32))


class Localizer:
    """Localizes images against landmarks (paper, Sec. 3.3 "Self-supervision").

    Keypoints are matched to the landmarks' mean descriptors, SIFT with Lowe's ratio test, learned ones as mutual nearest
    neighbours; the pose is estimated by `PoseEstimator`. The extractor must be that of the map, and may be omitted if
    nothing is extracted. The device is "cpu" or a CUDA device. `map_dir` is the folder of the map, which LightGlue needs
    (`LocalizerConfig.lightglue`). Raises MapError if the landmarks have no descriptors, or not the extractor's.
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
            self._check_kind(extractor)
        self._extract_with = extractor
        self._device = device
        matcher = DescriptorMatcher if self.kind.in_bytes else SimilarityMatcher
        self._matcher = matcher(landmarks.descriptors, device)
        self._guided: LightGlueMatcher | None = None
        if self.config.lightglue:
            from wheretolook.localization.lightglue import LightGlueMatcher

            self._guided = LightGlueMatcher(landmarks, map_dir, self.config.lightglue, device)
        self._camera = camera
        self.estimator = PoseEstimator(landmarks.points, self.config)

    @cached_property
    def extractor(self) -> KeypointExtractor:
        """Extractor for queries, built when first used."""
        config = self._extract_with or ExtractorConfig()
        self._check_kind(config)
        return KeypointExtractor(config, self._device)

    def _check_kind(self, extractor: ExtractorConfig) -> None:
        if kind_of(extractor.method) != self.kind:
            problem = f"the map has {self.kind.name} descriptors"
            fix = "Use this extractor for queries, or map again with --map.extractor.method."
            raise MapError(problem, value=extractor.method, fix=fix)

    def localize(self, rgb: NDArray[np.uint8]) -> Localization:
        """Localize one image (H, W, 3) uint8."""
        keypoints = self.extractor.extract(rgb)
        return self.estimate(keypoints, *self.match([keypoints])[0])

    def extract(self, images: Sequence[NDArray[np.uint8]]) -> list[Keypoints]:
        """Step 1: extract keypoints from images, each (H, W, 3) uint8 and all of one size."""
        return self.extractor.extract_batch(images)

    def match(self, keypoints: Sequence[Keypoints], camera: Camera | None = None) -> list[Matches]:
        """Step 2: match keypoints of several images with landmarks. The result for an image does not depend on the others."""
        matches = self._match(keypoints)
        if self._guided is None:
            return matches
        camera = camera or self._camera
        size = (camera.width, camera.height)
        return [
            self._guided.match(query, size, rows, self.config.lightglue_images)
            for query, (_, rows) in zip(keypoints, matches, strict=True)
        ]

    def _match(self, keypoints: Sequence[Keypoints]) -> list[Matches]:
        descriptors = [self.kind.store(of_image.descriptors) for of_image in keypoints]
        if isinstance(self._matcher, SimilarityMatcher):
            limit = self.config.min_similarity
            return self._matcher.match(descriptors, self.kind.min_similarity if limit is None else limit)
        return match(self._matcher, descriptors, self.config.max_ratio)

    def estimate(
        self,
        keypoints: Keypoints,
        keypoint_rows: NDArray[np.int64],
        landmark_rows: NDArray[np.int64],
        camera: Camera | None = None,
    ) -> Localization:
        """Step 3: estimate the pose of an image from its matches, rows (M,) of keypoints and rows (M,) of landmarks."""
        n_matches = len(keypoint_rows)
        matched_pixels = keypoints.pixels[keypoint_rows]
        matched: dict[str, Any] = {"matched_rows": landmark_rows, "matched_pixels": matched_pixels}
        if n_matches < self.config.min_matches:
            return Localization(TOO_FEW_MATCHES, None, n_matches, **matched)
        result = self.estimator.estimate(matched_pixels, landmark_rows, camera or self._camera)
        if result is None:
            return Localization(NO_POSE, None, n_matches, **matched)
        cam_from_world, inliers = result
        status = LOCALIZED if inliers.sum() >= self.config.min_inliers else NO_POSE
        return Localization(status, cam_from_world, n_matches, landmark_rows[inliers], **matched)
