"""Matches keypoints again under a pose hypothesis: with the landmarks that the pose projects near them.

Matching against the whole map loses keypoints of repeated structure, since Lowe's ratio test rejects a landmark that has
a twin. Where a pose predicts the landmark, the twin elsewhere is no alternative. So a correct pose gains matches, which
make it more accurate, and a wrong pose gains few.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from wheretolook.geometry.poses import Float, transform
from wheretolook.localization.rig import Look

MAX_NEAREST_RATIO = 1.15
"""Maximum ratio of the descriptor distances to the predicted landmark and to the nearest landmark of the map."""

MAX_CANDIDATES = 16
"""Maximum number of projected landmarks near a keypoint whose descriptors are compared."""

MIN_DEPTH = 0.05  # of landmarks in front of the camera, in metres


@dataclass(frozen=True, eq=False)
class StoredKeypoints:
    """All keypoints of an image, with descriptors as the map stores them.

    Attributes:
        pixels: (K, 2) in the image.
        descriptors: (K, D), see `DescriptorKind.store`.
        nearest: (K,) squared descriptor distance to the nearest landmark of the map.
    """

    pixels: Float
    descriptors: NDArray[Any]
    nearest: Float


class GuidedMatcher:
    """Matches keypoints with landmarks near them under a pose, from points (N, 3) m and their descriptors (N, D)."""

    def __init__(self, points: Float, descriptors: NDArray[Any]) -> None:
        self.points = points
        self.descriptors = descriptors

    def match(self, look: Look, cam_from_world: Float, radius_px: float) -> Look:
        """Return the view with the matches of all its keypoints that agree with a pose up to a radius in pixels.

        A keypoint matches the landmark nearest in descriptor space among those projected within the radius, if no
        landmark of the map is nearer by more than `MAX_NEAREST_RATIO`; a landmark keeps its nearest keypoint.
        """
        keypoints = look.keypoints
        assert keypoints is not None
        rows, pixels = self._in_image(look, cam_from_world, radius_px)
        if not len(rows) or not len(keypoints.pixels):
            return replace(look, pixels=keypoints.pixels[:0], rows=rows[:0])
        count = min(MAX_CANDIDATES, len(rows))
        distance, near = cKDTree(pixels).query(keypoints.pixels, count, distance_upper_bound=radius_px)
        keypoint, candidate = np.nonzero(np.isfinite(distance.reshape(-1, count)))
        landmark = rows[near.reshape(-1, count)[keypoint, candidate]]
        difference = keypoints.descriptors[keypoint].astype(np.float32) - self.descriptors[landmark]
        squared = np.einsum("md,md->m", difference, difference)
        kept = squared <= MAX_NEAREST_RATIO**2 * keypoints.nearest[keypoint]
        order = np.flatnonzero(kept)[np.argsort(squared[kept], kind="stable")]
        for values in (keypoint, landmark):  # each keypoint once, then each landmark once
            order = order[np.sort(np.unique(values[order], return_index=True)[1])]
        return replace(look, pixels=keypoints.pixels[keypoint[order]], rows=landmark[order])

    def _in_image(self, look: Look, cam_from_world: Float, margin_px: float) -> tuple[NDArray[np.int64], Float]:
        """Rows (M,) and pixels (M, 2) of the landmarks that a pose projects into the image, or nearly."""
        in_camera = transform(cam_from_world, self.points)
        rows = np.flatnonzero(in_camera[:, 2] > MIN_DEPTH)
        pixels = look.camera.project(in_camera[rows])
        size = look.camera.width + margin_px, look.camera.height + margin_px
        inside = (pixels > -margin_px).all(axis=1) & (pixels < size).all(axis=1)
        return rows[inside], pixels[inside]
