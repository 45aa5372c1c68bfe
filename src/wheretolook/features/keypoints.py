"""Keypoints with their descriptors, and how they are extracted: settings and results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wheretolook.utils.errors import ConfigError


@dataclass(frozen=True)
class ExtractorConfig:
    """Settings of the keypoint extractor.

    Args:
        method: whose SIFT to run. `opencv` finds nearly the same keypoints as `colmap`, COLMAP's own extraction on the
            CPU, in 40 % of the time; on a GPU, Warp kernels find OpenCV's up to rounding.
        first_octave: -1 doubles the image first, which gives about three times as many (and smaller) keypoints, for
            `colmap` at four times the cost; 0 starts at the image's own size. COLMAP's default is -1.
        max_keypoints: the most keypoints kept an image. `colmap` prefers large scales, `opencv` strong contrast.
        peak_threshold: least contrast (difference of Gaussians, grey values in [0, 1]). COLMAP's default is 0.02 / 3.
        edge_threshold: largest ratio of principal curvatures (Lowe 2004, section 4.1).
    """

    method: Literal["opencv", "colmap"] = "opencv"
    first_octave: int = -1
    max_keypoints: int = 2048
    peak_threshold: float = 0.02 / 3
    edge_threshold: float = 10.0

    def __post_init__(self) -> None:
        if self.method not in ("colmap", "opencv"):
            raise ConfigError("unknown extractor method", value=self.method, fix="Choose colmap or opencv")
        if self.first_octave not in (-1, 0):
            raise ConfigError("first_octave must be -1 or 0", value=self.first_octave)
        if self.max_keypoints < 1:
            raise ConfigError("max_keypoints must be positive", value=self.max_keypoints)
        if not (self.peak_threshold > 0 and self.edge_threshold > 0):
            raise ConfigError(
                "peak_threshold and edge_threshold must be positive", value=(self.peak_threshold, self.edge_threshold)
            )


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of one image.

    Attributes:
        pixels: (N, 2) float32, (x, y) in pixels; (0.5, 0.5) is the centre of the top-left pixel.
        descriptors: (N, 128) float32 RootSIFT (Arandjelovic and Zisserman, CVPR 2012) of unit length.
        scales_px: (N,) float32, standard deviation in pixels of the Gaussian at which the keypoint was found.
    """

    pixels: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    scales_px: NDArray[np.float32]

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
