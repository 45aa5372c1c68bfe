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
_TOGETHER = {"cpu": 1, "cuda": 16}  # images: those of learned features are few keypoints, and a GPU waits for each step


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
        together = _TOGETHER[self.device.type]
        return [
            found
            for start in range(0, len(descriptors), together)
            for found in self._match(descriptors[start : start + together], min_similarity)
        ]

    def _match(self, descriptors: Sequence[NDArray[np.float16]], min_similarity: float) -> list[Matches]:
        """Of images that go together. Their keypoints lie in rows as long as that of the image with most."""
        counts = np.array([len(of_image) for of_image in descriptors])
        images = len(counts)
        most = counts.max()
        if most == 0 or self.n_landmarks == 0:
            return [(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)) for _ in descriptors]
        padded = np.zeros((images, most, self._descriptors.shape[1]), np.float16)
        for row, of_image in zip(padded, descriptors, strict=True):
            row[: len(of_image)] = of_image
        queries = torch.from_numpy(padded).to(self.device, self._number).flatten(0, 1)
        missing = torch.from_numpy(np.arange(most) >= counts[:, None]).to(self.device)[..., None]
        best = torch.full((images, most), -torch.inf, device=self.device)
        rows = torch.zeros((images, most), dtype=torch.int64, device=self.device)
        keypoint_of: list[Tensor] = []
        block = max(1, _PRODUCTS[self.device.type] // len(queries))
        for start in range(0, self.n_landmarks, block):
            product = self._product(queries, self._descriptors[start : start + block]).view(images, most, -1)
            product = product.masked_fill_(missing, -torch.inf)
            keypoint_of.append(product.argmax(1))
            value, row = product.max(2)
            better = value > best
            best = torch.where(better, value, best)
            rows = torch.where(better, row + start, rows)
        mutual = torch.cat(keypoint_of, 1).gather(1, rows) == torch.arange(most, device=self.device)
        image, keypoint = (mutual & (best >= min_similarity) & ~missing[..., 0]).nonzero().unbind(1)
        found = torch.stack([image, keypoint, rows[image, keypoint]]).cpu().numpy()
        ends = np.searchsorted(found[0], np.arange(1, images))
        return list(zip(np.split(found[1], ends), np.split(found[2], ends), strict=True))

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
