"""Matches of keypoints with landmarks, by Lowe's ratio test."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray


class Matches(NamedTuple):
    """2D-3D matches of one image.

    Attributes:
        keypoints: (M,) rows of keypoints, ascending.
        landmarks: (M,) rows of their landmarks.
        near: (K, C) rows of the landmarks whose descriptors are nearest to each keypoint's.
        squared: (K, C) their squared distances, ascending.
    """

    keypoints: NDArray[np.int64]
    landmarks: NDArray[np.int64]
    near: NDArray[np.int64]
    squared: NDArray[np.float32]

    @classmethod
    def none(cls, n_keypoints: int) -> Matches:
        """No matches of an image with so many keypoints."""
        rows = np.zeros(0, dtype=np.int64)
        return cls(rows, rows, np.zeros((n_keypoints, 0), dtype=np.int64), np.zeros((n_keypoints, 0), dtype=np.float32))


class NearestLandmarks(Protocol):
    """Finds landmarks by their descriptors; see `DescriptorMatcher.nearest`."""

    n_landmarks: int

    def nearest(
        self, descriptors: NDArray[np.uint8], count: int = 2
    ) -> tuple[NDArray[np.int64], NDArray[np.float32 | np.int64]]: ...


def match(
    matcher: NearestLandmarks, descriptors: Sequence[NDArray[np.uint8]], max_ratio: float, count: int = 2
) -> list[Matches]:
    """2D-3D matches of several images, from their descriptors (K_i, 128) uint8, with each keypoint's nearest landmarks.

    A match passes Lowe's ratio test (IJCV 2004, Sec. 7.1): the nearest landmark's distance is less than `max_ratio` of
    the second nearest's. A landmark keeps only its nearest keypoint. With a single landmark, nothing matches.
    """
    lengths = [len(of_image) for of_image in descriptors]
    if sum(lengths) == 0 or matcher.n_landmarks < 2:
        return [Matches.none(length) for length in lengths]
    near, squared = matcher.nearest(np.concatenate(descriptors), count)
    ends = np.cumsum(lengths)[:-1]
    images = zip(np.split(near, ends), np.split(squared, ends), strict=True)
    return [_by_ratio(rows, distances, max_ratio) for rows, distances in images]


def _by_ratio(near: NDArray[np.int64], squared: NDArray[np.float32 | np.int64], max_ratio: float) -> Matches:
    keypoints = np.flatnonzero(squared[:, 0] < max_ratio**2 * squared[:, 1])
    landmarks = near[keypoints, 0]
    order = np.lexsort((keypoints, squared[keypoints, 0], landmarks))
    unique = np.sort(order[np.unique(landmarks[order], return_index=True)[1]])
    return Matches(keypoints[unique], landmarks[unique], near, squared.astype(np.float32))
