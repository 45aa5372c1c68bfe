"""Matching of learned descriptors: mutual nearest neighbours from a similarity on, as hloc matches them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wheretolook.features.matching import Matches

_PRODUCTS = {"cpu": 2**22, "cuda": 2**25}  # at a time: of a CPU they stay in its cache, on a GPU more are slower


class SimilarityMatcher:
    """Matches keypoints of images with descriptors (N, D) float16 of landmarks, on "cpu" or a CUDA device.

    Products are summed in single precision. `mutual_plain` is the twin.
    """

    def __init__(self, descriptors: NDArray[np.float16], device: str = "cpu") -> None:
        self.device = torch.device(device)
        self.n_landmarks = len(descriptors)
        self._number = torch.float32 if self.device.type == "cpu" else torch.float16
        self._descriptors = torch.from_numpy(descriptors).to(self.device, self._number)

    def match(self, descriptors: Sequence[NDArray[np.float16]], min_similarity: float) -> list[Matches]:
        """2D-3D matches of several images, from their descriptors (K_i, D) float16.

        Keypoint and landmark match if each is the other's nearest among all of the image and the map, and the cosine
        between their descriptors is at least `min_similarity`.
        """
        # OpenMP's limit is per thread: without this, the first product in a new thread would start a thread per core.
        torch.set_num_threads(torch.get_num_threads())
        return [self._match(of_image, min_similarity) for of_image in descriptors]

    def _match(self, descriptors: NDArray[np.float16], min_similarity: float) -> Matches:
        n = len(descriptors)
        if n == 0 or self.n_landmarks == 0:
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        queries = torch.from_numpy(descriptors).to(self.device, self._number)
        best = torch.full((n,), -torch.inf, device=self.device)
        rows = torch.zeros(n, dtype=torch.int64, device=self.device)
        keypoint_of: list[Tensor] = []
        block = max(1, _PRODUCTS[self.device.type] // n)
        for start in range(0, self.n_landmarks, block):
            product = self._product(queries, self._descriptors[start : start + block])
            keypoint_of.append(product.argmax(0))
            value, row = product.max(1)
            better = value > best
            best, rows = torch.where(better, value, best), torch.where(better, row + start, rows)
        mutual = torch.cat(keypoint_of)[rows] == torch.arange(n, device=self.device)
        keypoints = (mutual & (best >= min_similarity)).nonzero()[:, 0]
        return keypoints.cpu().numpy(), rows[keypoints].cpu().numpy()

    def _product(self, queries: Tensor, landmarks: Tensor) -> Tensor:
        if self.device.type == "cpu":
            return queries @ landmarks.T
        return torch.mm(queries, landmarks.T, out_dtype=torch.float32)


def mutual_plain(queries: NDArray[Any], descriptors: NDArray[Any], min_similarity: float) -> Matches:
    """Plain twin of `SimilarityMatcher.match` for one image: all products, compared."""
    product = queries.astype(np.float64) @ descriptors.astype(np.float64).T
    rows = product.argmax(1)
    keypoints = np.arange(len(queries))
    good = (product.argmax(0)[rows] == keypoints) & (product.max(1) >= min_similarity)
    return keypoints[good], rows[good]
