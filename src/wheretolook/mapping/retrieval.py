"""Choose pairs of photographs to match: all, or those that show the same by their features, and neighbours by name."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wheretolook.features.extractor import DescriptorKind, Stored
from wheretolook.mapping.triangulation import choose_pairs
from wheretolook.utils.texts import LOG


def photograph_pairs(
    stored: Sequence[Stored], kind: DescriptorKind, exhaustive_up_to: int, overlap: int, partners: int = 20
) -> NDArray[np.int64]:
    """Choose pairs (P, 2) of n photographs to match, i < j: all pairs, if n does not exceed `exhaustive_up_to`.

    Otherwise each with the `partners` whose global descriptors are most similar. Where names are in the order of
    capture, so that the next photograph mostly is among the `overlap` most similar, also with the `overlap` that follow
    and as many at distances that double, as COLMAP's sequential matching does.
    """
    n = len(stored)
    if n <= exhaustive_up_to:
        return np.column_stack(np.triu_indices(n, 1)).astype(np.int64)
    descriptors = global_descriptors(stored, kind)
    similarity = (descriptors @ descriptors.T).astype(np.float64)
    np.fill_diagonal(similarity, -1)
    pairs = choose_pairs(similarity, partners, 0.0)
    rank_of_next = (similarity[:-1] > np.diagonal(similarity, 1)[:, None]).sum(1)
    in_order = np.median(rank_of_next) < overlap
    by_name = "also with its neighbours by name" if in_order else "not by name, which is not the order of capture"
    LOG.info("%d photographs: each is matched with the %d most similar, %s", n, partners, by_name)
    if in_order:
        steps = sorted({*range(1, overlap + 1), *(2**power for power in range(overlap))})
        following = [np.column_stack([np.arange(n - step), np.arange(step, n)]) for step in steps if step < n]
        pairs = np.unique(np.concatenate([pairs, *following]), axis=0)
    return pairs


def global_descriptors(stored: Sequence[Stored], kind: DescriptorKind, n_words: int = 64) -> NDArray[np.float32]:
    """Compute a descriptor (I, n_words * D) of unit length of each image from its local ones, less the mean of all.

    It is VLAD (Jegou et al., CVPR 2010) with normalized words (Arandjelovic and Zisserman, CVPR 2013) that are trained
    on these images.
    """
    from scipy.cluster.vq import kmeans2  # takes longer than all of --help

    n_sampled = max(100, 20_000 // len(stored))  # of each image: k-means takes seconds
    rng = np.random.default_rng(0)
    samples = [descriptors[rng.permutation(len(descriptors))[:n_sampled]] for _, descriptors in stored]
    words = kmeans2(kind.restore(np.concatenate(samples)), n_words, minit="points", rng=rng)[0].astype(np.float32)
    of_images = np.zeros((len(stored), n_words, words.shape[1]), dtype=np.float32)
    for image, (_, descriptors) in enumerate(stored):
        values = kind.restore(descriptors)
        nearest = (values @ words.T - (words**2).sum(1) / 2).argmax(1)
        of_word = (nearest[:, None] == np.arange(n_words)).astype(np.float32)
        of_images[image] = of_word.T @ values - of_word.sum(0)[:, None] * words
    of_images /= np.maximum(np.linalg.norm(of_images, axis=2, keepdims=True), 1e-9)
    flat = of_images.reshape(len(stored), -1)
    flat -= flat.mean(0)
    return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9), dtype=np.float32)
