"""What an extractor is: one record that says how it is named, what its descriptors are like, and how it extracts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from wheretolook.features.descriptors import DescriptorKind
from wheretolook.features.keypoints import Keypoints


class ExtractorSettings(Protocol):
    """What an extractor is told, see `wheretolook.features.config.ExtractorConfig`, which knows all extractors."""

    @property
    def first_octave(self) -> int:
        """-1 to double the image first."""
        ...

    @property
    def max_keypoints(self) -> int:
        """Largest number of keypoints for each image."""
        ...

    @property
    def peak_threshold(self) -> float:
        """Least contrast of SIFT's keypoints."""
        ...

    @property
    def edge_threshold(self) -> float:
        """Largest ratio of principal curvatures of SIFT's keypoints."""
        ...

    @property
    def weights(self) -> str:
        """File of a network; empty for kornia's copy."""
        ...


class Extraction(Protocol):
    """An extractor that is ready on its device."""

    batch: int  # images of 640 x 480 that it works on at once, as on a GPU; 1 where each is alone

    def extract_batch(self, images: Sequence[NDArray[np.uint8]]) -> list[Keypoints]:
        """At most `max_keypoints` keypoints of each of the images (H, W, 3) uint8 of one size.

        Those of an image, and their order, do not depend on the others. ValueError for another shape or type.
        """
        ...


@dataclass(frozen=True)
class Extractor:
    """A way to find keypoints, or, without `build`, one that is known from other programs' files alone.

    Its record stands in a module of `features/` that `registry.MODULES` names. What imports PyTorch, OpenCV or COLMAP
    does so inside the functions given here.
    """

    name: str  # in options: `map.extractor.method`
    about: str  # one sentence
    descriptors: DescriptorKind
    build: Callable[[ExtractorSettings, str], Extraction] | None = None  # from settings and a device, "cpu" or CUDA
    weights: str = ""  # the file of a network's weights, as their authors call it; "" for none
    lightglue: str = ""  # what kornia's LightGlue calls it; "" where there is none for it
