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

    def by_quality(self) -> Matches:
        """Sort the matches by their distance over that of the last of the nearest landmarks, ascending."""
        near = self.squared[self.keypoints]
        order = np.argsort(near[:, 0] / np.maximum(near[:, -1], 1e-9), kind="stable")
        return self._replace(keypoints=self.keypoints[order], landmarks=self.landmarks[order])


class NearestLandmarks(Protocol):
    """Finds landmarks by their descriptors; see `DescriptorMatcher.nearest`."""

    n_landmarks: int

    def nearest(
        self, descriptors: NDArray[np.uint8], count: int = 2
    ) -> tuple[NDArray[np.int64], NDArray[np.float32 | np.int64]]: ...


def match(
    matcher: NearestLandmarks,
    descriptors: Sequence[NDArray[np.uint8]],
    max_ratio: float,
    count: int = 2,
    twins: NDArray[np.uint8] | None = None,
) -> list[Matches]:
    """2D-3D matches of several images, from their descriptors (K_i, 128) uint8, with each keypoint's nearest landmarks.

    A match passes Lowe's ratio test (IJCV 2004, Sec. 7.1): the nearest landmark's distance is less than `max_ratio` of
    the second nearest's, or of the nearest that is no twin of it (`is_twin`), given the descriptors (N, 128) of a map
    that `has_twins`. A landmark keeps only its nearest keypoint. With a single landmark, nothing matches.
    """
    lengths = [len(of_image) for of_image in descriptors]
    if sum(lengths) == 0 or matcher.n_landmarks < 2:
        return [Matches.none(length) for length in lengths]
    near, squared = matcher.nearest(np.concatenate(descriptors), count)
    ends = np.cumsum(lengths)[:-1]
    images = zip(np.split(near, ends), np.split(squared, ends), strict=True)
    return [_by_ratio(rows, distances, max_ratio, twins) for rows, distances in images]


def _by_ratio(
    near: NDArray[np.int64], squared: NDArray[np.float32 | np.int64], max_ratio: float, twins: NDArray[np.uint8] | None
) -> Matches:
    second = squared[:, 1]
    if twins is not None and near.shape[1] > 2:
        others = ~is_twin(near, near[:, 0], twins)
        others[:, -1] = True
        second = squared[np.arange(len(near)), others[:, 1:].argmax(1) + 1]
    keypoints = np.flatnonzero(squared[:, 0] < max_ratio**2 * second)
    landmarks = near[keypoints, 0]
    order = np.lexsort((keypoints, squared[keypoints, 0], landmarks))
    unique = np.sort(order[np.unique(landmarks[order], return_index=True)[1]])
    return Matches(keypoints[unique], landmarks[unique], near, squared.astype(np.float32))


def is_twin(near: NDArray[np.int64], first: NDArray[np.int64], descriptors: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Whether landmarks in rows (K, C) have nearly the descriptor of the one in rows (K,): a cosine above 0.98."""
    of_near = descriptors[np.minimum(near, len(descriptors) - 1)].astype(
        np.float32
    )  # few landmarks leave rows without one
    products = (of_near @ descriptors[first, :, None].astype(np.float32))[..., 0]
    return products > 0.98 * 512**2


def has_twins(matcher: NearestLandmarks, descriptors: NDArray[np.uint8], points: NDArray[np.float64]) -> bool:
    """Whether landmarks (N, 128) uint8 at points (N, 3) m were copied: a model merged with itself, or a simulator's rooms.

    Of a sample, half have a twin, and these are as far from one another as the landmarks themselves, which repeated
    texture is not.
    """
    if matcher.n_landmarks < 8:
        return False
    rows = np.unique(np.linspace(0, len(points) - 1, 256).astype(np.int64))
    near, _ = matcher.nearest(descriptors[rows], 2)
    other = np.where(near[:, 0] == rows, near[:, 1], near[:, 0])
    twin = is_twin(other[:, None], rows, descriptors)[:, 0]
    if twin.mean() < 0.5:
        return False
    steps, copied = (np.linalg.norm(np.diff(points[of[twin]], axis=0), axis=1) for of in (rows, other))
    return bool((np.abs(steps - copied) < 0.02 * steps + 0.02).mean() > 0.25)
