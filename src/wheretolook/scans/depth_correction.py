"""Correct the depths of a structured-light camera by the landmarks of a map of its colour images.

Such a camera measures disparity, and 1 / depth is linear in it. So a disparity that is a little off, or a baseline that
is not the nominal one, shows as 1 / z = factor / depth + offset, with errors that grow with the square of the depth:
Khoshelham and Elberink, "Accuracy and Resolution of Kinect Depth Data", Sensors 2012, eq. 4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float

MIN_LANDMARKS = 200
"""Fewest landmarks with a reading for a fit."""
MIN_RANGE = 1.5
"""Smallest ratio of far to near depths (90 % and 10 % of the readings) that determines the offset."""
_NOISE = 0.01  # of the depth; larger errors count less (Cauchy)
_NEAREST_M = 0.1


@dataclass(frozen=True)
class DepthCorrection:
    """1 / z = `factor` / depth + `offset_per_m`, of depths in metres along the optical axis."""

    factor: float = 1.0
    offset_per_m: float = 0.0

    def apply(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Correct depths of any shape; 0, which means no reading, stays 0."""
        inverse = np.float32(self.factor) / np.maximum(depth_m, np.float32(1e-3)) + np.float32(self.offset_per_m)
        return np.where((depth_m > 0) & (inverse > 0), 1 / np.where(inverse > 0, inverse, 1), 0).astype(np.float32)

    def describe(self) -> str:
        """Text of the correction at 1, 2 and 3 m."""
        at = np.arange(1, 4, dtype=np.float32)
        return ", ".join(f"{100 * by:+.1f} cm at {z:g} m" for z, by in zip(at, self.apply(at) - at, strict=True))


def fit_depth_correction(true_m: Float, read_m: Float) -> DepthCorrection | None:
    """Fit the correction from readings (N,) to true depths (N,) of landmarks; None if they do not determine it.

    About a third of the readings may be outliers, such as a surface in front of the landmark.
    """
    from scipy.optimize import least_squares

    usable = (read_m > _NEAREST_M) & (true_m > _NEAREST_M)
    true_m = true_m[usable]
    read_m = read_m[usable]
    if len(read_m) < MIN_LANDMARKS or np.quantile(read_m, 0.9) < MIN_RANGE * np.quantile(read_m, 0.1):
        return None

    def relative_errors(values: Float) -> Float:
        # that of 1 / z, times z: as that of z, but finite wherever the search goes
        return np.asarray(true_m * (values[0] / read_m + values[1]) - 1)

    found = least_squares(relative_errors, (1.0, 0.0), loss="cauchy", f_scale=_NOISE, x_scale=(1.0, 0.3))
    return DepthCorrection(float(found.x[0]), float(found.x[1]))
