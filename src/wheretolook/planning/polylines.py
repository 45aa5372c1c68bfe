"""Lengths along polylines, and values between their corners."""

from __future__ import annotations

import numpy as np

from wheretolook.geometry.poses import Float


def lengths_along(places: Float) -> Float:
    """Length from the start of a polyline (S, 3) to each of its corners, (S,), in its unit."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])


def between(knots: Float, values: Float, at: Float) -> Float:
    """Values (S, C) at ascending knots (S,), linearly interpolated at (W,); (W, C)."""
    return np.column_stack([np.interp(at, knots, column) for column in values.T])
