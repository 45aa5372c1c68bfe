"""Settings of the keypoint extractor, and its result: keypoints with their descriptors."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wheretolook.utils.errors import ConfigError


@dataclass(frozen=True)
class ExtractorConfig:
    """Settings of the keypoint extractor.

    Args:
        method: whose SIFT finds keypoints, opencv or colmap. `opencv` finds nearly the same keypoints as `colmap`,
            COLMAP's own extraction on the CPU, in 40 % of the time; on a GPU, Warp kernels find OpenCV's up to
            rounding.
        first_octave: -1 doubles the image first, which gives about three times as many (and smaller) keypoints, for
            `colmap` at four times the cost; 0 starts at the image's own size. COLMAP's default is -1.
        max_keypoints: largest number of keypoints for each image. `colmap` prefers large scales, `opencv` strong
            contrast.
        peak_threshold: least contrast (difference of Gaussians, grey values in [0, 1]). COLMAP's default is 0.02 / 3.

    Attributes:
        edge_threshold: largest ratio of principal curvatures: the value of Lowe 2004 (section 4.1), COLMAP and OpenCV.
    """

    method: Literal["opencv", "colmap"] = "opencv"
    first_octave: int = -1
    max_keypoints: int = 2048
    peak_threshold: float = 0.02 / 3
    edge_threshold: float = field(default=10.0, init=False)

    def __post_init__(self) -> None:
        if self.method not in ("colmap", "opencv"):
            raise ConfigError("unknown extractor method", value=self.method, fix="Choose colmap or opencv")
        if self.first_octave not in (-1, 0):
            raise ConfigError("first_octave must be -1 or 0", value=self.first_octave)
        if self.max_keypoints < 1:
            raise ConfigError("max_keypoints must be positive", value=self.max_keypoints)
        if not self.peak_threshold > 0:
            raise ConfigError("peak_threshold must be positive", value=self.peak_threshold)


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of one image."""

    pixels: NDArray[np.float32]  # (N, 2) (x, y) in pixels; (0.5, 0.5) is the centre of the top-left pixel
    descriptors: NDArray[np.float32]  # (N, 128) RootSIFT (Arandjelovic and Zisserman, CVPR 2012) of unit length
    scales_px: NDArray[np.float32]  # (N,) standard deviation of the Gaussian at which the keypoint was found

    def __len__(self) -> int:
        return len(self.pixels)

    @classmethod
    def none(cls) -> Keypoints:
        """No keypoints."""
        return cls(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), np.zeros(0, np.float32))


def quantize_descriptors(descriptors: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """Unit descriptors (N, D) as COLMAP stores them, (N, D) uint8: 512 times the value, rounded, at most 255."""
    return np.clip(np.rint(512 * descriptors), 0, 255).astype(np.uint8)


def unit_descriptors(descriptors: NDArray[Any]) -> NDArray[np.float32]:
    """Stored descriptors (N, D), e.g. uint8, as float32 of unit length (rows of zeros stay zero)."""
    values = descriptors.astype(np.float32)
    length = np.linalg.norm(values, axis=1, keepdims=True)
    values /= np.where(length > 0, length, 1)
    return values
