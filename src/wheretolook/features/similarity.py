"""Matches learned descriptors: mutual nearest neighbours above a similarity, as in hloc."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wheretolook.features.matches import Matches
from wheretolook.features.matching import GROUP, largest

_PRODUCTS = {"cpu": 2**22, "cuda": 2**25}  # per block: a CPU keeps them in its cache, on a GPU more are slower
_BATCH = {"cpu": 1, "cuda": 16}  # images per batch; learned extractors give few keypoints per image


class SimilarityMatcher:
    """Matches keypoints of images with descriptors (N, D) float16 of landmarks, on "cpu" or a CUDA device.

    Products are summed in single precision.
    """

    def __init__(self, descriptors: NDArray[np.float16], device: str = "cpu") -> None:
        self.device = torch.device(device)
        self.n_landmarks = len(descriptors)
        self._number = torch.float32 if self.device.type == "cpu" else torch.float16
        self._descriptors = torch.from_numpy(descriptors).to(self.device, self._number)

    def match(self, descriptors: Sequence[NDArray[np.float16]], min_similarity: float, count: int = 1) -> list[Matches]:
        """2D-3D matches of several images, from their descriptors (K_i, D) float16, with each keypoint's nearest landmarks.

        Keypoint and landmark match if each is the other's nearest among all of the image and the map, and the cosine
        between their descriptors is at least `min_similarity`.
        """
        # OpenMP's limit is per thread: without this, the first product in a new thread would start a thread per core.
        torch.set_num_threads(torch.get_num_threads())
        batch = _BATCH[self.device.type]
        return [
            matches
            for start in range(0, len(descriptors), batch)
            for matches in self._match(descriptors[start : start + batch], min_similarity, count)
        ]

    def _match(self, descriptors: Sequence[NDArray[np.float16]], min_similarity: float, count: int) -> list[Matches]:
        """Match one batch of images, padded to the image with most keypoints."""
        counts = np.array([len(of_image) for of_image in descriptors])
        images = len(counts)
        max_count = counts.max()
        if max_count == 0 or self.n_landmarks == 0:
            return [Matches.none(int(number)) for number in counts]
        padded = np.zeros((images, max_count, self._descriptors.shape[1]), np.float16)
        for row, of_image in zip(padded, descriptors, strict=True):
            row[: len(of_image)] = of_image
        queries = torch.from_numpy(padded).to(self.device, self._number).flatten(0, 1)
        missing = torch.from_numpy(np.arange(max_count) >= counts[:, None]).to(self.device)[..., None]
        best = torch.full((len(queries), count), -torch.inf, device=self.device)
        near = torch.zeros((len(queries), count), dtype=torch.int64, device=self.device)
        keypoint_of: list[Tensor] = []
        block = GROUP * max(count, _PRODUCTS[self.device.type] // len(queries) // GROUP)
        for start in range(0, self.n_landmarks, block):
            product = self._product(queries, self._descriptors[start : start + block]).view(images, max_count, -1)
            product = product.masked_fill_(missing, -torch.inf)
            keypoint_of.append(product.argmax(1))
            rows, values = _largest(product.flatten(0, 1), count)
            values = torch.cat([best, values], 1)
            best, kept = values.topk(count, dim=1)
            near = torch.cat([near, rows + start], 1).gather(1, kept)
        first = near[:, 0].view(images, max_count)
        similar = (best[:, 0] >= min_similarity).view(images, max_count)
        mutual = torch.cat(keypoint_of, 1).gather(1, first) == torch.arange(max_count, device=self.device)
        image, keypoint = (mutual & similar & ~missing[..., 0]).nonzero().unbind(1)
        keypoints, rows = torch.stack([keypoint, first[image, keypoint]]).cpu().numpy()
        ends = np.searchsorted(image.cpu().numpy(), np.arange(1, images))
        near_rows = near.view(images, max_count, count).cpu().numpy()
        squared = (2 - 2 * best.float()).clamp(min=0).view(images, max_count, count).cpu().numpy()
        parts = zip(np.split(keypoints, ends), np.split(rows, ends), near_rows, squared, counts.tolist(), strict=True)
        return [Matches(points, landmarks, of_each[:n], far[:n]) for points, landmarks, of_each, far, n in parts]

    def _product(self, queries: Tensor, landmarks: Tensor) -> Tensor:
        if self.device.type == "cpu":
            return queries @ landmarks.T
        return torch.mm(queries, landmarks.T, out_dtype=torch.float32)


def _largest(product: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Columns of the largest numbers of each row (k, n), and the numbers, descending; (k, count or n)."""
    if count == 1:
        values, rows = product.max(1, keepdim=True)
        return rows, values
    if product.shape[1] % GROUP or product.shape[1] < GROUP * count:
        values, rows = product.topk(min(count, product.shape[1]), dim=1)
        return rows, values
    return largest(product, count)
