"""Matches keypoints with landmarks by Lowe's ratio test: exact nearest neighbours, by matrix products."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


class Matches(NamedTuple):
    """2D-3D matches of one image.

    Attributes:
        keypoints: (M,) rows of keypoints, ascending.
        landmarks: (M,) rows of their landmarks.
        nearest: (K,) squared descriptor distance of each keypoint of the image to the nearest landmark.
    """

    keypoints: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    nearest: NDArray[np.float32]

    @classmethod
    def none(cls, n_keypoints: int) -> Matches:
        """No matches of an image with so many keypoints."""
        rows = np.zeros(0, dtype=np.int64)
        return cls(rows, rows, np.full(n_keypoints, np.inf, dtype=np.float32))


GROUP = 32  # landmarks; the two best groups are selected first, and in them the two best landmarks
# Size of a block of products. Products of few queries are slow; on a GPU, where each worker holds a block and its
# intermediate results, blocks of 1 GiB are no faster.
_PRODUCT_BYTES = {"cpu": 2**24, "cuda": 2**27}


class DescriptorMatcher:
    """Finds nearest neighbours among the landmarks' descriptors (N, 128) uint8, on "cpu" or a CUDA device.

    Descriptors are compared as COLMAP stores them, as whole numbers, by their scalar products. These are exact, in
    eight-bit integers on a CPU and in half precision with single-precision sums on a GPU: both give the same
    neighbours, and those of one descriptor do not depend on the other queries. A CPU whose byte products saturate or
    are slow uses single precision, where 128 * 255^2 < 2^24 is exact, too.
    """

    def __init__(self, descriptors: NDArray[np.uint8], device: str = "cpu") -> None:
        self.device = torch.device(device)
        n, length = descriptors.shape
        self.n_landmarks = n
        self._in_bytes = self.device.type == "cpu" and _byte_products_are_fast()
        padded = -(-max(n, 2 * GROUP) // GROUP) * GROUP
        whole = torch.zeros((padded, length), dtype=torch.int32)
        whole[:n] = torch.from_numpy(descriptors.astype(np.int32))
        if self._in_bytes:  # in signed bytes: q.d = (q - 128).(d - 128) + 128 (sum of d) + terms that depend on q only
            self._descriptors = (whole - 128).to(torch.int8).T
            self._bias = 128 * whole.sum(1, dtype=torch.int32)
            self._bias[n:] = -(2**28)  # rows of padding are never nearest
        else:
            number = torch.float32 if self.device.type == "cpu" else torch.float16
            self._descriptors = whole.to(self.device, number).T

    def nearest_two(
        self, descriptors: NDArray[np.uint8]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Row of the nearest landmark of each descriptor (K, 128), and its products with the two nearest; (K,) each.

        Ties are broken arbitrarily. With fewer than two landmarks, a missing product is -2^28.
        """
        # OpenMP's limit is per thread: without this, the first product in a new thread would start a thread per core.
        torch.set_num_threads(torch.get_num_threads())
        queries = torch.from_numpy(descriptors).to(self.device)
        block = max(1, _PRODUCT_BYTES[self.device.type] // (4 * self._descriptors.shape[1]))
        parts = [self._best_two(part) for part in queries.split(block)]
        rows, best = (torch.cat([part[i] for part in parts]).cpu().long().numpy() for i in (0, 1))
        return rows, best[:, 0], best[:, 1]

    def _best_two(self, queries: Tensor) -> tuple[Tensor, Tensor]:
        """Row of the nearest landmark, (k,), and the two largest products, (k, 2)."""
        query_bias = torch.zeros((), device=self.device)
        if self._in_bytes:
            whole = queries.to(torch.int32)
            product = torch._int_mm((whole - 128).to(torch.int8), self._descriptors).add_(self._bias)
            query_bias = 128 * (whole.sum(1, keepdim=True) - 128 * queries.shape[1])
        else:
            if self.device.type == "cpu":
                product = queries.float() @ self._descriptors
            else:
                product = torch.mm(queries.to(torch.float16), self._descriptors, out_dtype=torch.float32)
            product[:, self.n_landmarks :] = -(2**28)
        # A group's landmarks are a stride apart: maxima of neighbours in memory take a GPU several times as long.
        groups = product.view(len(product), GROUP, self._descriptors.shape[1] // GROUP)
        best_groups = groups.amax(1).topk(2, dim=1).indices
        candidates = groups.gather(2, best_groups[:, None].expand(-1, GROUP, -1)).flatten(1)  # of both groups in turns
        best, best_candidates = candidates.topk(2, dim=1)
        first = best_candidates[:, :1]
        rows = (best_groups.gather(1, first % 2) + first // 2 * groups.shape[2])[:, 0]
        return rows, best + query_bias


@cache
def _byte_products_are_fast() -> bool:
    """Whether this CPU sums products of signed bytes fast and without saturation, as with VNNI instructions.

    Without them AVX-512 adds pairs of products in 16 bits, and large ones overflow. With AVX2 they are right, but
    PyTorch's plain loop takes eighteen times as long as products in single precision.
    """
    if torch.backends.cpu.get_cpu_capability() == "AVX2":
        return False
    left = torch.full((64, 128), 127)
    right = torch.full((128, 64), 127)
    left[::2] = -128
    right[:, ::2] = -128
    try:
        product = torch._int_mm(left.to(torch.int8), right.to(torch.int8))
    except RuntimeError:  # not supported at all
        return False
    return torch.equal(product.long(), left @ right)


def match(matcher: DescriptorMatcher, descriptors: Sequence[NDArray[np.uint8]], max_ratio: float) -> list[Matches]:
    """2D-3D matches of several images, from their descriptors (K_i, 128) uint8.

    A match passes Lowe's ratio test (IJCV 2004, Sec. 7.1): the nearest landmark's distance is less than `max_ratio` of
    the second nearest's. A landmark keeps only its nearest keypoint. With a single landmark, nothing matches.
    """
    lengths = [len(of_image) for of_image in descriptors]
    if sum(lengths) == 0 or matcher.n_landmarks < 2:
        return [Matches.none(length) for length in lengths]
    rows, nearest, second = matcher.nearest_two(np.concatenate(descriptors))
    # squared distances between descriptors of length 512; rounding makes some a little longer, hence the maximum
    distance, next_distance = (np.maximum(2 * (512**2 - best), 0) for best in (nearest, second))
    passed = distance < max_ratio**2 * next_distance
    parts = (np.split(values, np.cumsum(lengths)[:-1]) for values in (rows, distance, passed))
    return [_each_landmark_once(*of_image) for of_image in zip(*parts, strict=True)]


def _each_landmark_once(rows: NDArray[np.int64], distance: NDArray[np.int64], passed: NDArray[np.bool_]) -> Matches:
    keypoints = np.flatnonzero(passed)
    landmarks = rows[keypoints]
    order = np.lexsort((keypoints, distance[keypoints], landmarks))
    unique = np.sort(order[np.unique(landmarks[order], return_index=True)[1]])
    return Matches(keypoints[unique], landmarks[unique], distance.astype(np.float32))
