"""The record of an extractor: its name, its descriptors, and how to build it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from wheretolook.features.descriptors import DescriptorKind
from wheretolook.features.keypoints import Keypoints


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
