"""OpenCV's SIFT of a grey image as RootSIFT, on one CPU core."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wheretolook.features.extractor import ExtractorConfig, Keypoints, unit_descriptors


class RootSift:
    """Extracts keypoints from grey images."""

    def __init__(self, config: ExtractorConfig = ExtractorConfig()) -> None:
        import cv2

        self.max_keypoints = config.max_keypoints
        self.first_octave = config.first_octave
        # OpenCV divides its contrast threshold by the number of layers. Without the precise upscale, keypoints are
        # biased.
        self._sift = cv2.SIFT.create(
            0, 3, 3 * config.peak_threshold, config.edge_threshold, 1.6, enable_precise_upscale=True
        )

    def extract(self, grey: NDArray[np.uint8]) -> Keypoints:
        """Extract the keypoints of an image (H, W) uint8, those of most contrast first."""
        keypoints, descriptors = self._sift.detectAndCompute(np.ascontiguousarray(grey), None)
        if len(keypoints) == 0:
            return Keypoints.none()
        octave = np.array([k.octave & 255 for k in keypoints], dtype=np.uint8).view(np.int8)
        table = np.array([(*k.pt, k.size / 2, k.response, k.angle) for k in keypoints], dtype=np.float32)
        usable = np.flatnonzero(octave >= self.first_octave)
        x, y, scale, response, angle = table[usable].T
        keep = usable[np.lexsort((angle, scale, y, x, -response))[: self.max_keypoints]]
        descriptors = descriptors[keep]
        descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-12))
        # OpenCV puts (0, 0) at the centre of the top-left pixel.
        return Keypoints(table[keep, :2] + np.float32(0.5), unit_descriptors(descriptors))
