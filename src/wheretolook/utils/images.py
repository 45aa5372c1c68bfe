"""Reading of image files with limits: a few bytes of a file can unfold to gigabytes of pixels."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheretolook.utils.reading import check_file

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_PIXELS = 150_000_000
"""Of a photograph; three bytes of each, and a copy, take 900 MB."""

MAX_DEPTH_PIXELS = 25_000_000
"""Of a depth image; those registered to photographs of telephones have half of it."""


def image_size(path: Path, at_most: int = MAX_PIXELS) -> tuple[int, int]:
    """Width and height of an image as it is stored.

    ValueError if it is no regular file, no image, or has more pixels than `at_most`; OSError if it is missing.
    """
    from PIL import Image

    check_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the limit is ours
            with Image.open(path) as image:
                width, height = image.size
    except Exception as error:  # decoders raise errors of many kinds
        raise ValueError(f"this is no image: {error}") from error
    if width * height > at_most:
        raise ValueError(f"its {width} x {height} pixels are more than {at_most:,}")
    return width, height


def read_image(path: Path, flags: int, at_most: int = MAX_PIXELS) -> NDArray[Any]:
    """An image as `cv2.imread` reads it. ValueError if it cannot, or as `image_size`; OSError if it is missing."""
    import cv2

    image_size(path, at_most)
    try:
        image = cv2.imread(str(path), flags)
    except cv2.error as error:
        raise ValueError(error.err) from error
    if image is None:
        raise ValueError("this is no image, or not a whole one")
    return image
