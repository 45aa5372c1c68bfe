"""Localize an image or a rig against a map's landmarks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from wheretolook.dataset.config import LOCALIZED, NO_POSE, TOO_FEW_MATCHES
from wheretolook.features.extractor import (
    KINDS,
    ExtractorConfig,
    KeypointExtractor,
    Keypoints,
    kind_of,
    unit_descriptors,
)
from wheretolook.features.matches import Matches, has_twins, match
from wheretolook.features.matching import MAX_NEAREST, DescriptorIndex, DescriptorMatcher, SimilarityMatcher, has_index
from wheretolook.geometry.camera import Camera, PinholeCamera
from wheretolook.geometry.poses import Float, pose_error, transform
from wheretolook.geometry.similarity import poses_from
from wheretolook.localization.batched_estimation import BatchedEstimator
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.estimation import PoseEstimator
from wheretolook.localization.lightglue import LightGlueMatcher
from wheretolook.localization.missing import ExpectedLandmarks
from wheretolook.localization.rig import Look
from wheretolook.localization.rig_localization import POSES_OF_AN_IMAGE, JointLocalizer
from wheretolook.mapping.colmap_model import ModelArrays
from wheretolook.mapping.landmarks import MAP_ATTRIBUTES, Landmarks
from wheretolook.utils.devices import run_halving
from wheretolook.utils.errors import MapError

Matcher = DescriptorMatcher | DescriptorIndex | SimilarityMatcher


@dataclass(frozen=True, eq=False)
class Localization:
    """Result of localizing one image.

    Attributes:
        status: "localized", "too_few_matches" or "no_pose".
        cam_from_world: (3, 4) estimated pose, None if RANSAC found none. A pose with too few inliers is kept, but its
            status is "no_pose".
        inlier_rows: (I,) rows of the landmarks that agree with the pose; also of those matched only under its guidance.
        matched_rows: (M,) rows of all landmarks matched with the whole map.
        matched_pixels: (M, 2) float32, their pixels in the image.
        first: the result of method "first", where several hypotheses were found.
    """

    status: str
    cam_from_world: Float | None
    inlier_rows: NDArray[np.int64]
    matched_rows: NDArray[np.int64]
    matched_pixels: NDArray[np.float32]
    first: Localization | None = None


class Localizer:
    """Localizes images against landmarks (paper, Sec. 3.3 "Self-supervision").

    Keypoints are matched to the landmarks' mean descriptors, SIFT with Lowe's ratio test, learned ones as mutual nearest
    neighbours; the pose is estimated by `PoseEstimator`. The extractor must be that of the map, and may be omitted if
    nothing is extracted. The device is "cpu" or a CUDA device. LightGlue (`LocalizerConfig.lightglue`) needs the folder
    of the map, `map_dir`, and the features of its images, by default its database. `photographs` is whether these are
    photographs. Raises MapError if the landmarks have no descriptors, or not the extractor's.
    """

    def __init__(
        self,
        landmarks: Landmarks,
        camera: Camera,
        config: LocalizerConfig = LocalizerConfig(),
        extractor: ExtractorConfig | None = None,
        device: str = "cpu",
        map_dir: Path | None = None,
        features: Path | None = None,
        photographs: bool = False,
    ) -> None:
        if landmarks.descriptors is None:
            raise MapError("landmarks without descriptors cannot be matched", fix="Build the map with its database.")
        self.landmarks = landmarks
        self.config = config
        self.kind = KINDS[landmarks.features]
        self._extractor = extractor or ExtractorConfig()
        if extractor is not None:
            self._check_extractor()
        self._device = device
        self.in_batches = device != "cpu"
        self._descriptors = landmarks.descriptors
        indexed = self.kind.in_bytes and config.method == "hypotheses" and has_index(len(landmarks), device)
        self._matcher = DescriptorIndex(self._descriptors) if indexed else self._matcher_of(self._descriptors)
        self._guided: LightGlueMatcher | None = None
        if config.lightglue:
            self._guided = LightGlueMatcher(landmarks, map_dir, config.lightglue, device, features)
        self.camera = camera
        self.estimator = PoseEstimator(landmarks.points, config, photographs)

    @cached_property
    def extractor(self) -> KeypointExtractor:
        """Extractor for queries, built when first used."""
        self._check_extractor()
        return KeypointExtractor(self._extractor, self._device)

    def _check_extractor(self) -> None:
        if kind_of(self._extractor.method) != self.kind:
            problem = f"the map has {self.kind.name} descriptors"
            fix = "Use this extractor for queries, or map again with --mapping.extractor.method."
            raise MapError(problem, value=self._extractor.method, fix=fix)

    def localize(self, rgb: NDArray[np.uint8]) -> Localization:
        """Localize one image (H, W, 3) uint8."""
        keypoints = self.extractor.extract(rgb)
        return self.estimate(keypoints, self.match([keypoints])[0])

    def match(self, keypoints: Sequence[Keypoints], camera: Camera | None = None) -> list[Matches]:
        """Match keypoints of several images with landmarks. The result for an image does not depend on the others."""
        return self.by_lightglue(keypoints, self.match_descriptors(keypoints), camera)

    def match_among(self, keypoints: Keypoints, rows: NDArray[np.int64]) -> Matches:
        """Match keypoints of an image with the landmarks in rows (R,) alone, by their descriptors."""
        if len(rows) == 0:
            return Matches.none(len(keypoints))
        (found,) = self.match_descriptors([keypoints], rows)
        near = rows[np.minimum(found.near, len(rows) - 1)]  # with few landmarks, missing ones have large distances
        return found._replace(landmarks=rows[found.landmarks], near=near)

    def _matcher_of(self, descriptors: NDArray[Any]) -> Matcher:
        return (DescriptorMatcher if self.kind.in_bytes else SimilarityMatcher)(descriptors, self._device)

    def match_descriptors(
        self, keypoints: Sequence[Keypoints], among: NDArray[np.int64] | None = None
    ) -> list[Matches]:
        """Match keypoints of several images by their descriptors, also where LightGlue is configured.

        `among` are rows (R,) of the landmarks to match with alone, among which matches are then numbered.
        """
        matcher = self._matcher if among is None else self._matcher_of(self._descriptors[among])
        descriptors = [self.kind.store(of_image.descriptors) for of_image in keypoints]
        several = self.config.method == "hypotheses"
        if isinstance(matcher, SimilarityMatcher):
            limit = self.config.min_similarity
            limit = self.kind.min_similarity if limit is None else limit
            return matcher.match(descriptors, limit, MAX_NEAREST if several else 1)
        twins = self.twins if several else None
        if twins is not None and among is not None:
            twins = twins[among]
        return match(matcher, descriptors, self.config.max_ratio, MAX_NEAREST if several else 2, twins)

    @cached_property
    def twins(self) -> NDArray[np.uint8] | None:
        """Descriptors (N, 128) of the landmarks if they are copies of one another (`has_twins`) and matched by ratio."""
        if isinstance(self._matcher, SimilarityMatcher):
            return None
        return self._descriptors if has_twins(self._matcher, self._descriptors, self.landmarks.points) else None

    def by_lightglue(
        self, keypoints: Sequence[Keypoints], matches: list[Matches], camera: Camera | None = None
    ) -> list[Matches]:
        """Replace matches by those of LightGlue, if it is configured, with the mapping images that they lead to."""
        if self._guided is None:
            return matches
        camera = camera or self.camera
        size = (camera.width, camera.height)
        return [
            Matches(*self._guided.match(query, size, first.landmarks), first.near, first.squared)
            for query, first in zip(keypoints, matches, strict=True)
        ]

    def check_weights(self, images: ModelArrays, photographs: Iterable[tuple[int, NDArray[np.uint8], Camera]]) -> bool:
        """Check that learned descriptors of mapping images match those of the landmarks that they observe.

        Photographs are rows of `images`, of whose points all are landmarks, pixels (H, W, 3) uint8 and cameras of that
        size. Returns False if they observe too few landmarks to decide. Raises MapError if the weights of the extractor
        are not those of the map.
        """
        landmark = np.searchsorted(self.landmarks.ids, images.point_ids)[images.observation_point]
        n_seen = n_found = 0
        for row, rgb, camera in photographs:
            keypoints = self.extractor.extract(rgb)
            seen = landmark[images.observation_image == row]
            n_seen += len(seen)
            if len(keypoints) and len(seen):
                pixels = camera.project(transform(images.image_poses[row], self.landmarks.points[seen]))
                distance, nearest = cKDTree(keypoints.pixels).query(np.nan_to_num(pixels, nan=-1e6))
                cosine = (unit_descriptors(self._descriptors[seen]) * keypoints.descriptors[nearest]).sum(1)
                n_found += int(np.sum((distance < 1.5) & (cosine >= self.kind.min_similarity)))  # pixels
        if n_seen < 20:
            return False
        if n_found < 0.1 * n_seen:  # of images of another size still a quarter
            problem = f"the extractor finds {n_found} of the {n_seen} landmarks in mapping images again"
            fix = f"Give the weights of the map's {self.kind.name} features: --extractor-weights."
            raise MapError(problem, value=self._extractor.weights or "default weights", fix=fix)
        return True

    @cached_property
    def joint(self) -> JointLocalizer:
        """Localizes one view or several with exactly known rotations by several hypotheses."""
        return JointLocalizer(self.estimator, expected=self.expected)

    @cached_property
    def expected(self) -> ExpectedLandmarks:
        """Landmarks that a pose should have found."""
        landmarks = self.landmarks
        return ExpectedLandmarks.of(
            landmarks.points, landmarks.mapping_direction, landmarks.attributes(), MAP_ATTRIBUTES
        )

    def estimate(self, keypoints: Keypoints, matches: Matches, camera: Camera | None = None) -> Localization:
        """Estimate the pose of an image from its matches."""
        pixels = keypoints.pixels[matches.keypoints]
        rows = matches.landmarks
        if len(rows) < self.config.min_matches:
            return Localization(TOO_FEW_MATCHES, None, rows[:0], rows, pixels)
        if self.config.method == "hypotheses":
            look = Look.of(keypoints.pixels, matches, camera or self.camera)
            found = self.joint.single_view_poses(look, POSES_OF_AN_IMAGE)
            best = self.joint.localize([look], [found])
            inlier_rows = best.looks[0].rows[best.inliers[0]] if best.inliers else rows[:0]
            in_map = [(poses_from(pose, -self.estimator.origin), rows[inliers]) for pose, inliers in found[:1]]
            first = self._result(in_map[0] if in_map else None, pixels, rows)
            return Localization(best.status, best.rig_from_world, inlier_rows, rows, pixels, first)
        estimated = self.estimator.estimate(pixels, rows, camera or self.camera)
        return self._result(None if estimated is None else (estimated[0], rows[estimated[1]]), pixels, rows)

    def _result(
        self,
        estimated: tuple[Float, NDArray[np.int64]] | None,
        pixels: NDArray[np.float32],
        rows: NDArray[np.int64],
        first: Localization | None = None,
    ) -> Localization:
        """Return the result for a pose (3, 4), if there is one, with its inliers among matched rows (M,)."""
        if estimated is None:
            return Localization(NO_POSE, None, rows[:0], rows, pixels, first)
        pose, inlier_rows = estimated
        status = LOCALIZED if len(inlier_rows) >= self.config.min_inliers else NO_POSE
        return Localization(status, pose, inlier_rows, rows, pixels, first)

    @cached_property
    def _batched(self) -> BatchedEstimator:
        return BatchedEstimator(self.estimator, self._device)

    def estimate_batch(
        self, keypoints: Sequence[Keypoints], matches: Sequence[Matches], camera: Camera | None = None
    ) -> list[Localization]:
        """Estimate the poses of several images of a camera: on a GPU at once, if it is a pinhole."""
        camera = camera or self.camera
        views = list(zip(keypoints, matches, strict=True))
        if not (self.in_batches and isinstance(camera, PinholeCamera)):
            return [self.estimate(*view, camera) for view in views]
        several = self.config.method == "hypotheses"
        least = self.config.min_matches
        enough = [(found, pairs.by_quality()) for found, pairs in views if len(pairs.landmarks) >= least]
        count = POSES_OF_AN_IMAGE if several else 1
        estimated = iter(
            run_halving(lambda some: self._batched.localize(some, camera, count), enough) if enough else ()
        )
        results = []
        for found, pairs in views:
            rows = pairs.landmarks
            pixels = found.pixels[pairs.keypoints]
            if len(rows) < least:
                results.append(Localization(TOO_FEW_MATCHES, None, rows[:0], rows, pixels))
            else:
                first, best = next(estimated)
                of_first = self._result(first, pixels, rows)
                results.append(self._result(best, pixels, rows, of_first) if several else of_first)
        return results


def localization_errors(results: Sequence[Localization], true_poses: Float) -> tuple[Float, Float]:
    """Position (m) and orientation errors (degrees), (B,), of localized images; NaN without a pose."""
    no_pose: Float = np.full((3, 4), np.nan)
    return pose_error([no_pose if one.cam_from_world is None else one.cam_from_world for one in results], true_poses)
