"""Keypoints, kinds of descriptors, and the record of an extractor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of one image."""

    pixels: NDArray[np.float32]  # (N, 2) (x, y) in pixels; (0.5, 0.5) is the centre of the top-left pixel
    # (N, D) of unit length; of SIFT (N, 128) RootSIFT (Arandjelovic and Zisserman, CVPR 2012)
    descriptors: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.pixels)

    @classmethod
    def none(cls, dimension: int = 128) -> Keypoints:
        """No keypoints, with descriptors of a dimension."""
        return cls(np.zeros((0, 2), np.float32), np.zeros((0, dimension), np.float32))


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


class Extraction(Protocol):
    """An extractor on its device."""

    batch: int  # images of 640 x 480 in a batch; 1 on a CPU

    def extract_batch(self, images: Sequence[NDArray[np.uint8]]) -> list[Keypoints]:
        """Extract at most `max_keypoints` keypoints from each image (H, W, 3) uint8; all images have one size.

        The result for an image does not depend on the others. Raises ValueError for another shape or type.
        """
        ...


@dataclass(frozen=True)
class Extractor:
    """An extractor; without `build`, one whose keypoints are only read from files of other programs.

    Its record is in a module of `features/` that `registry.MODULES` names. PyTorch, OpenCV and COLMAP are imported only
    inside the functions given here.
    """

    name: str  # in options: `mapping.extractor.method`
    descriptors: DescriptorKind
    build: Callable[[Any, str], Extraction] | None = None  # from an `ExtractorConfig` and a device, "cpu" or CUDA
    weights: str = ""  # usual name of the file of a network's weights; "" for none
    lightglue: str = ""  # name of the extractor in kornia's LightGlue; "" if unsupported


def check_image(rgb: NDArray[np.uint8]) -> None:
    """Raise ValueError unless an image is (H, W, 3) uint8."""
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3:
        raise ValueError(f"expected an (H, W, 3) uint8 image, got {rgb.shape} {rgb.dtype}")
