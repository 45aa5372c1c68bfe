"""Extracts keypoints and descriptors from the images of the map and from queries."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from functools import lru_cache
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from wheretolook.features.config import ExtractorConfig
from wheretolook.features.extractor import Extraction
from wheretolook.features.keypoints import Keypoints
from wheretolook.features.registry import all_extractors
from wheretolook.utils.processes import WorkerPool


class KeypointExtractor:
    """Extracts keypoints with any extractor of `wheretolook.features.registry`, on a CPU core or a GPU.

    Raises ConfigError if kornia, a network's weights or the device is missing.
    """

    def __init__(self, config: ExtractorConfig = ExtractorConfig(), device: str = "cpu") -> None:
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
