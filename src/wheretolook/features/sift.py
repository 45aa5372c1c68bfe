"""SIFT (Lowe, IJCV 2004) as RootSIFT: OpenCV's and COLMAP's on a CPU core, Warp kernels' on a GPU."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from wheretolook.features.extractor import ExtractorConfig, Keypoints, check_image, unit_descriptors
from wheretolook.features.opencv_sift import RootSift
from wheretolook.utils.texts import quiet_colmap


class OpenCvSift:
    """OpenCV's SIFT on one CPU core; on a CUDA device by Warp kernels."""

    def __init__(self, config: ExtractorConfig, device: str) -> None:
        self.batch = 1 if device == "cpu" else 8
        self._extract: Callable[[Sequence[NDArray[np.uint8]]], list[Keypoints]]
        if device == "cpu":
            sift = RootSift(config)
            self._extract = lambda images: [sift.extract(grey_bitmap(rgb).to_array()) for rgb in images]
        else:
            from wheretolook.features.warp_sift import WarpSift, grey_images

            on_gpu = WarpSift(config, device)
            self._extract = lambda images: on_gpu.extract_many(grey_images(images, on_gpu.device))

    def extract_batch(self, images: Sequence[NDArray[np.uint8]]) -> list[Keypoints]:
        """Keypoints of images (H, W, 3) uint8 of one size, of which a GPU may have tensors, those of most contrast first."""
        return self._extract(images)


class ColmapSift:
    """COLMAP's SIFT on one CPU core; on a GPU it is not repeatable."""

    batch = 1

    def __init__(self, config: ExtractorConfig, device: str = "cpu") -> None:
        self.config = config
        options = pycolmap.FeatureExtractionOptions()
        options.num_threads = 1
        options.sift.first_octave = config.first_octave
        options.sift.max_num_features = config.max_keypoints
        options.sift.peak_threshold = config.peak_threshold
        options.sift.edge_threshold = config.edge_threshold
        with quiet_colmap():
            self._sift = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)

    def extract_batch(self, images: Sequence[NDArray[np.uint8]]) -> list[Keypoints]:
        """Keypoints of images (H, W, 3) uint8, the largest first."""
        return [self._extract(grey_bitmap(rgb)) for rgb in images]

    def _extract(self, bitmap: Any) -> Keypoints:
        keypoints, descriptors = self._sift.extract(bitmap)
        if len(keypoints) == 0:
            return Keypoints.none()
        table = np.array([(k.x, k.y, k.compute_scale()) for k in keypoints], dtype=np.float32)
        # COLMAP returns whole scale levels, from the largest down, so there can be more than the limit.
        keep = np.argsort(-table[:, 2], kind="stable")[: self.config.max_keypoints]
        return Keypoints(table[keep, :2], unit_descriptors(descriptors.data[keep]))


def grey_bitmap(rgb: NDArray[np.uint8]) -> Any:
    """Convert to grey as COLMAP does (Rec. 709 weights); with other weights other keypoints pass the thresholds."""
    check_image(rgb)
    return pycolmap.Bitmap.from_array(np.ascontiguousarray(rgb)).clone_as_grey()
