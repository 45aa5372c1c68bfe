"""Reads depth images."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from wheretolook.utils.errors import SceneError
from wheretolook.utils.files import MAX_DEPTH_PIXELS, load_npy, read_image

NO_READING = np.iinfo(np.uint16).max  # in 16-bit images of several cameras, as 0 in all


def read_depth(path: Path, scale: float = 1000.0) -> NDArray[np.float32]:
    """Read a depth image (H, W) in metres, 0 without a reading: PNG or TIFF (integers of `scale` a metre, or floats in
    metres) or NPY (metres).

    Raises OSError or ValueError if the file is missing or damaged, SceneError if its values are no depths.
    """
    is_array = path.suffix.lower() == ".npy"
    image = load_npy(path) if is_array else read_image(path, cv2.IMREAD_UNCHANGED, MAX_DEPTH_PIXELS)
    if image.ndim != 2 or image.dtype.kind not in "fui" or image.dtype.itemsize == 1:
        value = f"{image.dtype}, shape {image.shape}"
        raise SceneError("this is no depth image", path=path, value=value, fix="Write one channel of 16 bits as PNG.")
    depth_m = image.astype(np.float32) / np.float32(1.0 if image.dtype.kind == "f" else scale)
    if image.dtype == np.uint16:
        depth_m[image == NO_READING] = 0
    return depth_m
