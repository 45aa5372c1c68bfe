"""Options of extractors, and extraction of keypoints from images by them."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.features.extractor import Extraction, Keypoints
from wheretolook.features.opencv_sift import EDGE_THRESHOLD, MAX_KEYPOINTS, PEAK_THRESHOLD
from wheretolook.features.registry import all_extractors, runnable_extractors
from wheretolook.utils.errors import ConfigError, check_choice, check_positive, check_range, no_option
from wheretolook.utils.files import sha256
from wheretolook.utils.processes import WorkerPool


@dataclass(frozen=True)
class ExtractorConfig:
    """Settings of the keypoint extractor.

    Args:
        method: extractor: SIFT by opencv or colmap, or the learned aliked, disk and xfeat, which need
            `pip install 'wheretolook[learned]'`. `opencv` gives nearly the same keypoints as `colmap`, COLMAP's own
            extraction on the CPU, in 40 % of the time; on a GPU, Warp kernels give OpenCV's up to rounding.
        first_octave: first octave of SIFT: -1 doubles the image first, which gives about three times as many (and smaller)
            keypoints, for `colmap` at four times the cost; 0 starts at the image's own size. COLMAP's default is -1.
        max_keypoints: maximum number of keypoints per image. `colmap` prefers large scales, `opencv` strong
            contrast, learned ones high scores.
        peak_threshold: minimum contrast of SIFT keypoints (difference of Gaussians, grey values in [0, 1]). COLMAP's default is
            0.02 / 3.
        weights: weights file of a learned extractor as published by its authors (aliked-n16rot.pth, depth-save.pth of
            DISK, xfeat.pt). By default kornia's copy, from its cache or downloaded.

    Attributes:
        edge_threshold: maximum ratio of principal curvatures: the value of Lowe 2004 (section 4.1), COLMAP and OpenCV.
    """

    method: str = "opencv"
    first_octave: int = no_option(-1)
    max_keypoints: int = MAX_KEYPOINTS
    peak_threshold: float = no_option(PEAK_THRESHOLD)
    weights: str = ""
    edge_threshold: float = field(default=EDGE_THRESHOLD, init=False)

    def __post_init__(self) -> None:
        check_choice("extractor method", self.method, runnable_extractors())
        if self.weights and not all_extractors()[self.method].weights:
            raise ConfigError("this extractor has no weights", value=self.weights, fix="Leave extractor.weights out.")
        check_choice("first_octave", self.first_octave, (-1, 0))
        check_range("max_keypoints", self.max_keypoints, 1)
        check_positive("peak_threshold", self.peak_threshold)

    def record(self) -> dict[str, Any]:
        """Settings that decide the keypoints, as JSON values; weights by their checksum."""
        record = asdict(self)
        path = record.pop("weights")
        if path:
            record["weights_sha256"] = sha256(Path(path)) if Path(path).is_file() else None
        return record


class KeypointExtractor:
    """Extracts keypoints with any extractor of `wheretolook.features.registry`, on a CPU core or a GPU.

    Raises ConfigError if kornia, a network's weights or the device is missing.
    """

    def __init__(self, config: ExtractorConfig, device: str = "cpu") -> None:
        self.config = config
        build = all_extractors()[config.method].build
        assert build is not None  # as checked by ExtractorConfig
        self._extraction: Extraction = build(config, device)
        self.on_gpu = self._extraction.batch > 1

    def batch_of(self, width: int, height: int) -> int:
        """Number of images of a size in a batch: fewer large ones, which take more GPU memory."""
        return max(1, self._extraction.batch * 640 * 480 // (width * height))

    def extract(self, rgb: NDArray[np.uint8]) -> Keypoints:
        """Extract at most `max_keypoints` keypoints from an image (H, W, 3) uint8; their order depends only on the image.

        Raises ValueError if it has another shape or type.
        """
        return self.extract_batch([rgb])[0]

    def extract_batch(self, images: Sequence[NDArray[np.uint8]]) -> list[Keypoints]:
        """Extract keypoints from images (H, W, 3) uint8 of one size, on a GPU in one batch. See `extract`."""
        return self._extraction.extract_batch(images)

    def extract_many(
        self, images: Iterable[NDArray[np.uint8]], processes: WorkerPool
    ) -> Generator[Keypoints, None, None]:
        """Yield keypoints of many images (H, W, 3) uint8 in their order, from worker processes or GPU batches.

        Only a few images are read ahead. Processes, as pycolmap's extractor holds the interpreter lock; the result does
        not depend on their number.
        """
        if self.on_gpu:
            source = iter(images)
            for first in source:
                more = self.batch_of(first.shape[1], first.shape[0]) - 1
                yield from self.extract_batch([first, *islice(source, more)])
        elif processes.workers <= 1:
            yield from map(self.extract, images)
        else:
            yield from processes.map(_extract_in_worker, ((self.config, rgb) for rgb in images))


_extractor_of = lru_cache(maxsize=1)(KeypointExtractor)


def _extract_in_worker(job: tuple[ExtractorConfig, NDArray[np.uint8]]) -> Keypoints:
    config, rgb = job
    return _extractor_of(config).extract(rgb)
