"""What an extractor is: one record that says how it is named, what its descriptors are like, and how it extracts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from wheretolook.features.descriptors import DescriptorKind

if TYPE_CHECKING:
    from wheretolook.features.keypoints import ExtractorConfig, Keypoints


class Extraction(Protocol):
    """An extractor that is ready on its device."""

    in_batches: bool  # whether it works on several images at once, as on a GPU

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
    build: Callable[[ExtractorConfig, str], Extraction] | None = None  # from settings and a device, "cpu" or CUDA
    weights: str = ""  # the file of a network's weights, as their authors call it; "" for none
    lightglue: str = ""  # what kornia's LightGlue calls it; "" where there is none for it
