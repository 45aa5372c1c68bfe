"""Finds the exact nearest landmarks of descriptors, by matrix products."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

GROUP = 32  # landmarks; the best groups are selected first, and in them the best landmarks
CPU_GROUP = 16  # divides it; matching an image takes a tenth less than with 32
MAX_NEAREST = 16  # landmarks that `DescriptorMatcher.nearest` returns at most
MISSING_PRODUCT = -(2**28)
MISSING = 2**28  # squared distance
# Size of a block of products. Products of few queries are slow; on a GPU, where each worker holds a block and its
# intermediate results, blocks of 1 GiB are no faster. On a CPU blocks of 16 MiB, beyond its cache, take a tenth more.
_PRODUCT_BYTES = {"cpu": 2**23, "cuda": 2**27}
MIN_BLOCK = (
    16  # descriptors compared at a time, whatever the size of the map: with 4, a product takes 2.5 times as long
)


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
        padded = -(-max(n, MAX_NEAREST * GROUP) // GROUP) * GROUP
        whole = torch.zeros((padded, length), dtype=torch.int32)
        whole[:n] = torch.from_numpy(descriptors.astype(np.int32))
        if self._in_bytes:  # in signed bytes: q.d = (q - 128).(d - 128) + 128 (sum of d) + terms that depend on q only
            self._descriptors = (whole - 128).to(torch.int8).T
            self._bias = 128 * whole.sum(1, dtype=torch.int32)
            self._bias[n:] = MISSING_PRODUCT  # rows of padding are never nearest
        else:
            number = torch.float32 if self.device.type == "cpu" else torch.float16
            self._descriptors = whole.to(self.device, number).T

    def nearest(self, descriptors: NDArray[np.uint8], count: int = 2) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of the nearest landmarks of each descriptor (K, 128) and their squared distances, ascending; (K, count).

        Ties are broken arbitrarily. With fewer landmarks, the missing ones have distances above `MISSING`.
        """
        rows, products = self.products(descriptors, count)
        # of descriptors of length 512; rounding makes some a little longer, hence the maximum
        return rows, np.maximum(2 * (512**2 - products), 0)

    def products(self, descriptors: NDArray[np.uint8], count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of the nearest landmarks and their scalar products with each descriptor, descending; (K, count)."""
        # OpenMP's limit is per thread: without this, the first product in a new thread would start a thread per core.
        torch.set_num_threads(torch.get_num_threads())
        queries = torch.from_numpy(descriptors).to(self.device)
        block = max(MIN_BLOCK, _PRODUCT_BYTES[self.device.type] // (4 * self._descriptors.shape[1]))
        parts = [self._best(part, count) for part in queries.split(block)]
        rows, best = (torch.cat([part[i] for part in parts]).cpu().long().numpy() for i in (0, 1))
        return rows, best

    def _best(self, queries: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Rows of the nearest landmarks and their products, descending; (k, count)."""
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
            product[:, self.n_landmarks :] = MISSING_PRODUCT
        rows, best = largest(product, count)
        return rows, best + query_bias


def largest(product: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Columns of the largest numbers of each row of (k, n), and the numbers, descending; (k, count).

    `n` is a multiple of `GROUP`, of at least `count` groups.
    """
    # A group's columns are a stride apart: maxima of neighbours in memory take a GPU several times as long.
    size = CPU_GROUP if product.device.type == "cpu" else GROUP
    groups = product.view(len(product), size, product.shape[1] // size)
    best_groups = groups.amax(1).topk(count, dim=1).indices
    candidates = groups.gather(2, best_groups[:, None].expand(-1, size, -1)).flatten(1)  # of all groups in turns
    best, best_candidates = candidates.topk(count, dim=1)
    return best_groups.gather(1, best_candidates % count) + best_candidates // count * groups.shape[2], best


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
