"""Calibration of log-odds on views that nothing was learnt from (Platt 1999)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def fit_platt(logits: ArrayLike, labels: ArrayLike) -> tuple[float, float]:
    """Scale and offset with which scale * logits + offset are the likeliest log-odds of validation views' labels, (B,)
    each.

    Temperature scaling has no offset, so it mends how sure a model is, but not a level that is off. They are 1 and 0
    where a scale would turn the order round or the labels are of one class.
    """
    from sklearn.linear_model import LogisticRegression

    values, truth = np.asarray(logits, dtype=np.float64), np.asarray(labels).astype(bool)
    if truth.all() or not truth.any():
        return 1.0, 0.0
    line = LogisticRegression(C=1e6).fit(values[:, None], truth)
    scale, offset = float(line.coef_[0, 0]), float(line.intercept_[0])
    return (scale, offset) if scale > 0 else (1.0, 0.0)
