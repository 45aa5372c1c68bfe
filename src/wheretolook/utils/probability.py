"""Log-odds of probabilities."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import logit


def finite_log_odds(probability: ArrayLike, margin: float) -> NDArray[np.float64]:
    """Return log-odds (...,) of probabilities (...,) in [0, 1], clipped to `margin` .. 1 - `margin` so that they are finite."""
    return np.asarray(logit(np.clip(probability, margin, 1 - margin)))
