"""Plain versions of descriptor matching: all products, compared."""

import numpy as np


def nearest(queries, descriptors, count):
    """`DescriptorMatcher.products`."""
    product = queries.astype(np.int64) @ descriptors.astype(np.int64).T
    order = np.argsort(-product, axis=1, kind="stable")[:, :count]
    return order, np.take_along_axis(product, order, axis=1)


def mutual_matches(queries, descriptors, min_similarity):
    """`SimilarityMatcher.match` for one image."""
    product = queries.astype(np.float64) @ descriptors.astype(np.float64).T
    rows = product.argmax(1)
    keypoints = np.arange(len(queries))
    good = (product.argmax(0)[rows] == keypoints) & (product.max(1) >= min_similarity)
    return keypoints[good], rows[good]
