"""The pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import ConfigError


@dataclass(frozen=True)
class PinholeCamera:
    """Ideal pinhole camera.

    Args:
        width: image width in pixels.
        height: image height in pixels.
        focal_px: focal length in pixels, the same in x and y. The default, 320 px at 640 x 480, is the paper's camera
            (90 degrees across).
    """

    width: int = 640
    height: int = 480
    focal_px: float = 320.0

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1 or not self.focal_px > 0:
            value = (self.width, self.height, self.focal_px)
            raise ConfigError("camera needs a positive width, height and focal_px", value=value)

    @property
    def cx(self) -> float:
        """Principal point x in pixels: the image centre."""
        return self.width / 2

    @property
    def cy(self) -> float:
        """Principal point y in pixels: the image centre."""
        return self.height / 2

    @property
    def matrix(self) -> Float:
        """Intrinsic matrix K, (3, 3)."""
        return np.array([[self.focal_px, 0, self.cx], [0, self.focal_px, self.cy], [0, 0, 1]])

    def project(self, points_cam: ArrayLike) -> Float:
        """Pixels (..., 2) of points (..., 3) in the camera frame. Points behind the camera project too, so test z."""
        points = np.asarray(points_cam, dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            return points[..., :2] / points[..., 2:] * self.focal_px + (self.cx, self.cy)

    def in_image(self, pixels: ArrayLike) -> NDArray[np.bool_]:
        """Whether pixels (..., 2) lie in the image: 0 <= x < width and 0 <= y < height. NaN is outside."""
        return in_image(pixels, self.width, self.height)


def in_image(pixels: ArrayLike, width: int, height: int) -> NDArray[np.bool_]:
    """Whether pixels (..., 2) lie in an image: 0 <= x < width and 0 <= y < height. NaN is outside."""
    x, y = np.moveaxis(np.asarray(pixels), -1, 0)
    return (x >= 0) & (x < width) & (y >= 0) & (y < height)
