"""Extraction of SIFT keypoints and descriptors, for the images of the map and for queries alike."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from contextlib import nullcontext
from functools import lru_cache
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.features.keypoints import ExtractorConfig, Keypoints, unit_descriptors
from wheretolook.utils.colmap import quiet_colmap
from wheretolook.utils.processes import Processes

_GPU_BATCH = 8


class KeypointExtractor:
    """Extracts SIFT keypoints, on a CPU core or a GPU (COLMAP's on the CPU only: on a GPU it is not repeatable)."""

    def __init__(self, config: ExtractorConfig | None = None, device: str = "cpu") -> None:
        self.config = config or ExtractorConfig()
        self.on_gpu = device != "cpu" and self.config.method == "opencv"
        if self.on_gpu:
            from wheretolook.features.warp_sift import WarpSift

            self._extractor: Any = WarpSift(self.config, device)
        else:
            self._extractor = _colmap_sift(self.config) if self.config.method == "colmap" else _opencv_sift(self.config)

    def extract(self, rgb: NDArray[np.uint8]) -> Keypoints:
        """At most `max_keypoints` keypoints of an image (H, W, 3) uint8, in an order that depends on the image alone.

        Raises ValueError if it has another shape or type.
        """
        return self.extract_batch([rgb])[0]

    def extract_batch(self, images: Sequence[NDArray[np.uint8]]) -> list[Keypoints]:
        """Extract keypoints of images (H, W, 3) uint8 of one size, on a GPU all at once. See `extract`."""
        grey = [_grey(rgb) for rgb in images]
        if self.on_gpu:
            return list(self._extractor.extract_many(np.stack([bitmap.to_array() for bitmap in grey])))
        if self.config.method == "colmap":
            return [self._extract_colmap(bitmap) for bitmap in grey]
        return [self._extract_opencv(bitmap.to_array()) for bitmap in grey]

    def extract_many(
        self, images: Iterable[NDArray[np.uint8]], workers: int | Processes = 1
    ) -> Generator[Keypoints, None, None]:
        """Keypoints of many images (H, W, 3) uint8, in their order, extracted in worker processes or in GPU batches.

        Only a few images are read ahead. `workers` are processes, or how many to spawn (threads would wait for one
        another, since pycolmap's extractor holds Python's lock); 1 stays in this process. The result is the same.
        """
        if self.on_gpu:
            source = iter(images)
            while batch := list(islice(source, _GPU_BATCH)):
                yield from self.extract_batch(batch)
            return
        with nullcontext(workers) if isinstance(workers, Processes) else Processes(workers) as processes:
            if processes.workers <= 1:
                yield from map(self.extract, images)
            else:
                yield from processes.map(_extract_in_worker, ((self.config, rgb) for rgb in images))

    def _extract_colmap(self, bitmap: Any) -> Keypoints:
        keypoints, descriptors = self._extractor.extract(bitmap)
        if len(keypoints) == 0:
            return Keypoints.none()
        table = np.array([(k.x, k.y, k.compute_scale()) for k in keypoints], dtype=np.float32)
        # COLMAP keeps whole scale levels, from the largest down, so there can be more than the limit.
        keep = np.argsort(-table[:, 2], kind="stable")[: self.config.max_keypoints]
        return Keypoints(table[keep, :2], unit_descriptors(descriptors.data[keep]), table[keep, 2])

    def _extract_opencv(self, grey: NDArray[np.uint8]) -> Keypoints:
        found, descriptors = self._extractor.detectAndCompute(np.ascontiguousarray(grey), None)
        if len(found) == 0:
            return Keypoints.none()
        octave = np.array([k.octave & 255 for k in found], dtype=np.uint8).view(np.int8)
        table = np.array([(*k.pt, k.size / 2, k.response, k.angle) for k in found], dtype=np.float32)
        usable = np.flatnonzero(octave >= self.config.first_octave)
        x, y, scale, response, angle = table[usable].T
        keep = usable[np.lexsort((angle, scale, y, x, -response))[: self.config.max_keypoints]]
        descriptors = descriptors[keep]
        descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-12))
        # OpenCV puts (0, 0) at the centre of the top-left pixel.
        return Keypoints(table[keep, :2] + np.float32(0.5), unit_descriptors(descriptors), table[keep, 2])


def _grey(rgb: NDArray[np.uint8]) -> Any:
    """Convert to grey as COLMAP does (Rec. 709 weights); with other weights other keypoints pass the thresholds."""
    import pycolmap

    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise ValueError(f"expected an (H, W, 3) uint8 image, got {rgb.shape} {rgb.dtype}")
    return pycolmap.Bitmap.from_array(np.ascontiguousarray(rgb)).clone_as_grey()


def _colmap_sift(config: ExtractorConfig) -> Any:
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    options.sift.first_octave = config.first_octave
    options.sift.max_num_features = config.max_keypoints
    options.sift.peak_threshold = config.peak_threshold
    options.sift.edge_threshold = config.edge_threshold
    with quiet_colmap():
        return pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)


def _opencv_sift(config: ExtractorConfig) -> Any:
    import cv2

    # OpenCV divides its contrast threshold by the number of layers. Without the precise upscale, keypoints are biased.
    contrast = 3 * config.peak_threshold
    return cv2.SIFT.create(0, 3, contrast, config.edge_threshold, 1.6, enable_precise_upscale=True)


_extractor_of = lru_cache(maxsize=1)(KeypointExtractor)


def _extract_in_worker(job: tuple[ExtractorConfig, NDArray[np.uint8]]) -> Keypoints:
    config, rgb = job
    return _extractor_of(config).extract(rgb)
