"""Kinds of descriptors: dimension, storage format, and matching criterion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Stored = tuple[NDArray[np.float32], NDArray[Any]]
"""Keypoints of an image as stored in files: pixels (K, 2), and descriptors (K, D) as by `DescriptorKind.store`."""


@dataclass(frozen=True)
class DescriptorKind:
    """Descriptors of one extractor, or of several equivalent ones. All are compared by their angle.

    A kind is either stored as COLMAP stores SIFT, as bytes (512 times non-negative unit descriptors), and matched by
    Lowe's ratio; or stored as float16 unit descriptors, as hloc stores learned ones, and matched where both are each
    other's nearest with at least `min_similarity`.
    """

    name: str  # in maps, weights and messages
    dimension: int  # numbers in a descriptor
    stored_as: Literal["uint8", "float16"]
    min_similarity: float = 0.0  # minimum cosine of mutual nearest neighbours, if not matched by ratio
    colmap_type: int = -1  # its `FeatureExtractorType` in databases of COLMAP 4; -1 for none

    @property
    def in_bytes(self) -> bool:
        """Whether descriptors are stored as bytes and matched by Lowe's ratio."""
        return self.stored_as == "uint8"

    @property
    def columns(self) -> int:
        """Bytes of a descriptor in a COLMAP database, which stores floating-point numbers in single precision."""
        return self.dimension * (1 if self.in_bytes else 4)

    def store(self, descriptors: NDArray[np.floating[Any]]) -> NDArray[Any]:
        """Convert unit descriptors (N, D) to the format of files and matchers."""
        return quantize_descriptors(descriptors) if self.in_bytes else descriptors.astype(np.float16)

    def restore(self, stored: NDArray[Any]) -> NDArray[np.float32]:
        """Convert stored descriptors to (N, D) float32, of unit length up to rounding."""
        return (stored / 512).astype(np.float32) if self.in_bytes else stored.astype(np.float32)

    def none(self) -> NDArray[Any]:
        """Stored descriptors of no keypoints, (0, D)."""
        return np.zeros((0, self.dimension), dtype=self.stored_as)


def quantize_descriptors(descriptors: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """Unit descriptors (N, D) as COLMAP stores them, (N, D) uint8: 512 times the value, rounded, at most 255."""
    values = 512 * descriptors
    np.rint(values, out=values)
    np.clip(values, 0, 255, out=values)  # in place: new arrays of this size take longer than the computation
    return values.astype(np.uint8)


def unit_descriptors(descriptors: NDArray[Any]) -> NDArray[np.float32]:
    """Stored descriptors (N, D), e.g. uint8, as float32 of unit length (rows of zeros stay zero)."""
    values = descriptors.astype(np.float32)
    length = np.linalg.norm(values, axis=1, keepdims=True)
    values /= np.where(length > 0, length, 1)
    return values
