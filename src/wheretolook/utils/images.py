"""Reads image files with limits: a few bytes can expand to gigabytes of pixels."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheretolook.utils.files import check_file

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_PIXELS = 150_000_000
"""Limit for photographs; three bytes per pixel and a copy take 900 MB."""

MAX_DEPTH_PIXELS = 25_000_000
"""Limit for depth images; those of phones have half of it."""


def image_size(image: Path | bytes, at_most: int = MAX_PIXELS) -> tuple[int, int]:
    """Return width and height of an image file, or of its content.

    Raises ValueError if it is no image or has more pixels than `at_most`, OSError if it is missing.
    """
    from PIL import Image

    if isinstance(image, Path):
        check_file(image)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the limit is ours
            with Image.open(image if isinstance(image, Path) else io.BytesIO(image)) as opened:
                width, height = opened.size
    except Exception as error:  # decoders raise errors of many kinds
        raise ValueError(f"this is no image: {error}") from error
    if width * height > at_most:
        raise ValueError(f"its {width} x {height} pixels are more than {at_most:,}")
    return width, height


def read_image(path: Path, flags: int, at_most: int = MAX_PIXELS) -> NDArray[Any]:
    """Read an image with `cv2.imread`. Raises ValueError if that fails, and as `image_size`."""
    import cv2

    image_size(path, at_most)
    try:
        image = None if _is_cut_jpeg(path.read_bytes()) else cv2.imread(str(path), flags)
    except cv2.error as error:
        raise ValueError(error.err) from error
    if image is None:
        raise ValueError("this is no image, or not a whole one")
    return image


def _is_cut_jpeg(data: bytes) -> bool:
    """Return whether a JPEG lacks its end, the marker FFD9 after the first scan: OpenCV fills the missing part with grey.

    A thumbnail in the header has an end of its own, so segments are skipped by their lengths; fill bytes FF may precede
    a marker.
    """
    at = 2
    while data[at : at + 1] == b"\xff" and data[at + 1 : at + 2] != b"\xda":
        is_fill = data[at + 1 : at + 2] == b"\xff"
        at += 1 if is_fill else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return data.startswith(b"\xff\xd8") and data.find(b"\xff\xd9", at) < 0
