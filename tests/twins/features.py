"""Plain versions of descriptor matching: all products, compared."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def nearest(
    queries: NDArray[np.uint8], descriptors: NDArray[np.uint8], count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """`DescriptorMatcher.products`."""
    product = queries.astype(np.int64) @ descriptors.astype(np.int64).T
    order = np.argsort(-product, axis=1, kind="stable")[:, :count]
    return order, np.take_along_axis(product, order, axis=1)


def mutual_matches(queries: NDArray[Any], descriptors: NDArray[Any], min_similarity: float) -> tuple[NDArray[Any], ...]:
    """`SimilarityMatcher.match` for one image."""
    product = queries.astype(np.float64) @ descriptors.astype(np.float64).T
    rows = product.argmax(1)
    keypoints = np.arange(len(queries))
    good = (product.argmax(0)[rows] == keypoints) & (product.max(1) >= min_similarity)
    return keypoints[good], rows[good]
