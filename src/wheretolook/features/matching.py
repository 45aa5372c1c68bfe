"""Match descriptors: by ratio or mutual nearest neighbours, exactly or by an index, and the similarity of landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib.util import find_spec

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wheretolook.features.matches import Matches
from wheretolook.utils.texts import LOG

GROUP = 32  # landmarks; the best groups are selected first, and in them the best landmarks
MAX_NEAREST = 16  # landmarks that `DescriptorMatcher.nearest` returns at most
MISSING_PRODUCT = -(2**28)
# Size of a block of products. On a GPU, where each worker holds a block and its intermediate results, blocks of 1 GiB
# are no faster. On a CPU blocks of 16 MiB, beyond its cache, take a tenth more.
_PRODUCT_BYTES = {"cpu": 2**23, "cuda": 2**27}


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

        Ties are broken arbitrarily. With fewer landmarks, the missing ones have squared distances above 2^28.
        """
        rows, products = self.products(descriptors, count)
        # of descriptors of length 512; rounding makes some a little longer, hence the maximum
        return rows, np.maximum(2 * (512**2 - products), 0)

    def products(self, descriptors: NDArray[np.uint8], count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of the nearest landmarks and their scalar products with each descriptor, descending; (K, count)."""
        # OpenMP's limit is per thread: without this, the first product in a new thread would start a thread per core.
        torch.set_num_threads(torch.get_num_threads())
        queries = torch.from_numpy(descriptors).to(self.device)
        # products of few queries are slow: with 4, a product takes 2.5 times as long as with 16
        block = max(16, _PRODUCT_BYTES[self.device.type] // (4 * self._descriptors.shape[1]))
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
    size = 16 if product.device.type == "cpu" else GROUP  # on a CPU matching takes a tenth less than with 32
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


_PRODUCTS = {"cpu": 2**22, "cuda": 2**25}  # per block: a CPU keeps them in its cache, on a GPU more are slower


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
        batch = 1 if self.device.type == "cpu" else 16  # images; learned extractors give few keypoints in each
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


def has_index(n_landmarks: int, device: str) -> bool:
    """Return whether an index serves a map of this size; warns if it would but FAISS is missing.

    The exact search takes about a second for 2,000 keypoints in a map of 200,000 landmarks.
    """
    if device != "cpu" or n_landmarks < 200_000:
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

    def __init__(self, descriptors: NDArray[np.uint8], lists: int = 1024) -> None:
        import faiss

        self.n_landmarks, length = descriptors.shape
        self._descriptors = descriptors
        self._quantizer = faiss.IndexFlatL2(length)
        self._index = faiss.IndexIVFPQFastScan(self._quantizer, length, lists, length // 2, 4)
        self._index.cp.niter = 8
        self._index.nprobe = 32  # lists that are searched
        n_training = min(self.n_landmarks, 40 * lists)
        sample = np.random.default_rng(0).choice(self.n_landmarks, n_training, replace=False)
        self._index.train(descriptors[sample].astype(np.float32))
        block = 100_000  # in single precision
        for start in range(0, self.n_landmarks, block):
            self._index.add(descriptors[start : start + block].astype(np.float32))

    def nearest(self, descriptors: NDArray[np.uint8], count: int = 2) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of the nearest landmarks of each descriptor (K, 128) and their squared distances, ascending; (K, count).

        Landmarks that the index does not find have the squared distance 2^28.
        """
        _, proposed = self._index.search(descriptors.astype(np.float32), 64)  # candidates of each keypoint
        block = 256  # keypoints that are compared with their candidates at a time
        parts = [np.zeros((0, count), dtype=np.int64)]
        distances = parts.copy()
        for start in range(0, len(descriptors), block):
            rows = proposed[start : start + block]
            candidates = self._descriptors[rows].astype(np.float32)
            queries = descriptors[start : start + block, :, None].astype(np.float32)
            products = (candidates @ queries)[..., 0].astype(np.int64)  # exact: 128 * 255^2 < 2^24
            # of descriptors of length 512; rounding makes some a little longer, hence the maximum
            squared = np.where(rows < 0, 2**28, np.maximum(2 * (512**2 - products), 0))
            order = np.argsort(squared, axis=1, kind="stable")[:, :count]
            parts.append(np.maximum(np.take_along_axis(rows, order, 1), 0))
            distances.append(np.take_along_axis(squared, order, 1))
        return np.concatenate(parts), np.concatenate(distances)
