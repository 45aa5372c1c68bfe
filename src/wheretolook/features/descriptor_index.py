"""Finds the nearest landmarks of a large map by an index of FAISS (Douze et al., 2024)."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

from wheretolook.features.matching import MISSING
from wheretolook.utils.logs import LOG

MIN_LANDMARKS = 200_000
"""Landmarks from which on an image is matched by the index: up to here the exact search takes about a second for 2,000 keypoints."""

_LISTS = 1024
_SEARCHED_LISTS = 32
_CANDIDATES = 64  # landmarks that the index proposes for a keypoint
_TRAINING_PER_LIST = 40
_BLOCK = 100_000  # landmarks added at a time, in single precision
_QUERIES = 256  # keypoints compared with their candidates at a time


def has_index(n_landmarks: int, device: str) -> bool:
    """Return whether an index serves a map of this size; warns if it would but FAISS is missing."""
    if device != "cpu" or n_landmarks < MIN_LANDMARKS:
        return False
    if find_spec("faiss") is None:
        advice = "pip install 'wheretolook[large]' makes this more than twenty times as fast"
        LOG.warning("%s landmarks are matched without an index: %s", f"{n_landmarks:,}", advice)
        return False
    return True


class DescriptorIndex:
    """Finds nearest neighbours among the landmarks' descriptors (N, 128) uint8, on a CPU.

    An inverted file with product quantization proposes candidates; their distances are exact, as those of
    `DescriptorMatcher`. One keypoint in a hundred has another nearest landmark than by the exact search.
    """

    def __init__(self, descriptors: NDArray[np.uint8]) -> None:
        import faiss

        self.n_landmarks, length = descriptors.shape
        self._descriptors = descriptors
        self._quantizer = faiss.IndexFlatL2(length)
        self._index = faiss.IndexIVFPQFastScan(self._quantizer, length, _LISTS, length // 2, 4)
        self._index.cp.niter = 8
        self._index.nprobe = _SEARCHED_LISTS
        n_training = min(self.n_landmarks, _TRAINING_PER_LIST * _LISTS)
        sample = np.random.default_rng(0).choice(self.n_landmarks, n_training, replace=False)
        self._index.train(descriptors[sample].astype(np.float32))
        for start in range(0, self.n_landmarks, _BLOCK):
            self._index.add(descriptors[start : start + _BLOCK].astype(np.float32))

    def nearest(self, descriptors: NDArray[np.uint8], count: int = 2) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of the nearest landmarks of each descriptor (K, 128) and their squared distances, ascending; (K, count).

        Landmarks that the index does not find have the distance `MISSING`.
        """
        _, proposed = self._index.search(descriptors.astype(np.float32), _CANDIDATES)
        parts = [np.zeros((0, count), dtype=np.int64)]
        distances = parts.copy()
        for start in range(0, len(descriptors), _QUERIES):
            rows = proposed[start : start + _QUERIES]
            candidates = self._descriptors[rows].astype(np.float32)
            queries = descriptors[start : start + _QUERIES, :, None].astype(np.float32)
            products = (candidates @ queries)[..., 0].astype(np.int64)  # exact: 128 * 255^2 < 2^24
            # of descriptors of length 512; rounding makes some a little longer, hence the maximum
            squared = np.where(rows < 0, MISSING, np.maximum(2 * (512**2 - products), 0))
            order = np.argsort(squared, axis=1, kind="stable")[:, :count]
            parts.append(np.maximum(np.take_along_axis(rows, order, 1), 0))
            distances.append(np.take_along_axis(squared, order, 1))
        return np.concatenate(parts), np.concatenate(distances)
