"""Global localization of one image against a map of landmarks, without any knowledge of its pose."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray

from wheretolook.errors import MapError
from wheretolook.geometry import Float, PinholeCamera
from wheretolook.labelling.config import LocalizerConfig
from wheretolook.mapping.extraction import ExtractorConfig, KeypointExtractor, unit_descriptors
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.table import LOCALIZED, NO_POSE, TOO_FEW_MATCHES


@dataclass(frozen=True, eq=False)
class Localization:
    """What came of localizing one image.

    Attributes:
        status: "localized", "too_few_matches" or "no_pose".
        cam_from_world: (3, 4) estimated pose, None if RANSAC found none. A pose with too few inliers is kept for the
            record, but its status is "no_pose".
        n_matches: 2D-3D matches.
        inlier_rows: rows of the landmarks that were matched and agree with the pose.
    """

    status: str
    cam_from_world: Float | None
    n_matches: int
    inlier_rows: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


class Localizer:
    """Localizes images against landmarks (paper, Sec. 3.3 "Self-supervision").

    SIFT, one matrix product against the landmarks' mean descriptors, Lowe's ratio test, then PnP in LO-RANSAC and
    refinement by pycolmap.

    Args:
        landmarks: with descriptors.
        camera: intrinsics of the images.
        config: matching and RANSAC settings.
        extractor: must be what the map was made with.
        device: where descriptors are matched, "cpu" or a CUDA device (there in half precision).

    Raises:
        MapError: the landmarks have no descriptors.
    """

    def __init__(
        self,
        landmarks: Landmarks,
        camera: PinholeCamera,
        config: LocalizerConfig | None = None,
        extractor: ExtractorConfig | None = None,
        device: str = "cpu",
    ) -> None:
        if landmarks.descriptors is None:
            raise MapError("landmarks without descriptors cannot be matched", fix="Build the map with its database.")
        self.landmarks, self.config, self.device = landmarks, config or LocalizerConfig(), device
        self.extractor = KeypointExtractor(extractor)
        self._dtype = torch.float32 if torch.device(device).type == "cpu" else torch.float16
        self._descriptors = torch.from_numpy(unit_descriptors(landmarks.descriptors)).to(device, self._dtype)
        self._camera = pycolmap.Camera(
            model="SIMPLE_PINHOLE",
            width=camera.width,
            height=camera.height,
            params=[camera.focal_px, camera.cx, camera.cy],
        )
        self._estimation = pycolmap.AbsolutePoseEstimationOptions()
        self._estimation.ransac.max_error = self.config.max_error_px
        self._estimation.ransac.random_seed = self.config.seed
        self._refinement = pycolmap.AbsolutePoseRefinementOptions()

    def localize(self, rgb: NDArray[np.uint8]) -> Localization:
        """Localize one image (H, W, 3) uint8."""
        keypoints = self.extractor.extract(rgb)
        keypoint_rows, landmark_rows = self.match(keypoints.descriptors)
        n_matches = len(keypoint_rows)
        if n_matches < self.config.min_matches:
            return Localization(TOO_FEW_MATCHES, None, n_matches)
        estimate = pycolmap.estimate_and_refine_absolute_pose(
            keypoints.pixels[keypoint_rows].astype(np.float64),
            self.landmarks.points[landmark_rows],
            self._camera,
            self._estimation,
            self._refinement,
        )
        if estimate is None:
            return Localization(NO_POSE, None, n_matches)
        pose = np.asarray(estimate["cam_from_world"].matrix())
        status = LOCALIZED if estimate["num_inliers"] >= self.config.min_inliers else NO_POSE
        return Localization(status, pose, n_matches, landmark_rows[np.asarray(estimate["inlier_mask"], dtype=bool)])

    def match(self, descriptors: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Match unit descriptors (K, 128) against the landmarks'.

        A match passes Lowe's ratio test (IJCV 2004, Sec. 7.1), and a landmark keeps only its most similar keypoint.

        Returns:
            Rows of the keypoints and rows of their landmarks, (M,) each, in ascending order of the keypoints.
        """
        if len(descriptors) == 0 or len(self._descriptors) < 2:
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        similarity = torch.from_numpy(descriptors).to(self.device, self._dtype) @ self._descriptors.T
        top, rows = (part.cpu() for part in torch.topk(similarity, 2, dim=1))
        distance = torch.sqrt(torch.clamp(2 - 2 * top.float(), min=0))
        kept = torch.nonzero(distance[:, 0] < self.config.max_ratio * distance[:, 1])[:, 0].numpy()
        landmark_rows, best = rows[:, 0].numpy()[kept], top[:, 0].float().numpy()[kept]
        by_landmark = np.lexsort((kept, -best, landmark_rows))
        first = np.ones(len(kept), dtype=bool)
        first[1:] = np.diff(landmark_rows[by_landmark]) > 0
        unique = np.sort(by_landmark[first])
        return kept[unique], landmark_rows[unique]
