"""Global localization of an image against a map of landmarks, without a prior on its pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import poselib
from numpy.typing import NDArray

from wheretolook.features.extraction import KeypointExtractor
from wheretolook.features.keypoints import ExtractorConfig, Keypoints
from wheretolook.features.matching import DescriptorMatcher, Matches, match
from wheretolook.features.registry import all_kinds, kind_of
from wheretolook.features.similarity import SimilarityMatcher
from wheretolook.geometry.camera import Camera, ColmapCamera, PinholeCamera
from wheretolook.geometry.local_origin import local_origin, poses_from
from wheretolook.geometry.poses import Float
from wheretolook.labelling.config import LocalizerConfig
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.utils.errors import MapError
from wheretolook.viewpoints.table import LOCALIZED, NO_POSE, TOO_FEW_MATCHES

if TYPE_CHECKING:
    from wheretolook.labelling.lightglue import LightGlueMatcher


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
    """

    status: str
    cam_from_world: Float | None
    n_matches: int
    inlier_rows: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    matched_rows: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


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
        self.landmarks, self.config = landmarks, config or LocalizerConfig()
        self.kind = all_kinds()[landmarks.features]
        if extractor is not None:
            self._refuse_other(extractor)
        self._extract_with, self._device = extractor, device
        by_ratio = self.kind.in_bytes
        self._matcher = (DescriptorMatcher if by_ratio else SimilarityMatcher)(landmarks.descriptors, device)
        self._guided: LightGlueMatcher | None = None
        if self.config.lightglue:
            from wheretolook.labelling.lightglue import LightGlueMatcher

            self._guided = LightGlueMatcher(landmarks, map_dir, self.config.lightglue, device)
        self._camera, self._origin = camera, local_origin(landmarks.points)
        self._ransac = {
            "max_reproj_error": self.config.max_error_px,
            "seed": self.config.seed,
            "success_prob": self.config.confidence,
            "min_iterations": self.config.min_trials,
            "max_iterations": self.config.max_trials,
            "dyn_num_trials_mult": 1.0,  # as many trials as the confidence asks for; PoseLib makes three times as many
        }
        # Keypoints are accurate to a fraction of a pixel. PoseLib's own scale is half of RANSAC's limit, as if outliers
        # just within the limit were accurate, too: poses are then worse.
        self._refinement = {"loss_type": "CAUCHY", "loss_scale": 1.0}

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
        seen_by, n_images = camera or self._camera, self.config.lightglue_images
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
        if n_matches < self.config.min_matches:
            return Localization(TOO_FEW_MATCHES, None, n_matches, matched_rows=landmark_rows)
        pixels, points = keypoints.pixels[keypoint_rows].astype(np.float64), self.landmarks.points[landmark_rows]
        taken_with, seen = _known_to_poselib((camera or self._camera).colmap, pixels)
        pose, found = poselib.estimate_absolute_pose(
            seen, points - self._origin, taken_with, self._ransac, self._refinement
        )
        if found["num_inliers"] < 3 or not np.isfinite(pose.Rt).all():  # no three matches determine a pose
            return Localization(NO_POSE, None, n_matches, matched_rows=landmark_rows)
        status = LOCALIZED if found["num_inliers"] >= self.config.min_inliers else NO_POSE
        inlier_rows = landmark_rows[np.asarray(found["inliers"], dtype=bool)]
        return Localization(status, poses_from(pose.Rt, -self._origin), n_matches, inlier_rows, landmark_rows)


POSELIBS_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")


def _known_to_poselib(camera: ColmapCamera, pixels: Float) -> tuple[dict[str, Any], Float]:
    """A camera as PoseLib takes it, and pixels (M, 2) of its image.

    Of a model that PoseLib does not know, pixels become those of a pinhole with the same focal length, by their rays.
    Rays that it would not see, more than 84 degrees off its axis, go far outside, where they are nobody's inliers.
    """
    if camera.model in POSELIBS_MODELS:
        return camera.record(), pixels
    pinhole = PinholeCamera(camera.width, camera.height, camera.mean_focal_px)
    rays = camera.unproject(pixels)
    ahead = rays[:, 2:] > 0.1
    return pinhole.colmap.record(), np.where(ahead, pinhole.project(np.where(ahead, rays, (0, 0, 1))), 1e6)
