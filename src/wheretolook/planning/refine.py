"""Improve directions of a lattice by a local search: scorers can score any pose, not only those of a lattice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.camera_turns import angles_to_axis_deg
from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.scorers.base import Scorer

COMPASS = np.stack([np.cos(np.arange(8) * np.pi / 4), np.sin(np.arange(8) * np.pi / 4)], axis=1)
"""Steps (8, 2) in the plane that touches the sphere at the current axis."""


@dataclass(frozen=True, eq=False)
class RefinedViews:
    """Result of a local search: unit axes (B, 3) in the world, their scores (B,), which are at least the scores (B,) at the
    start, and the number of scored views."""

    axes: Float
    scores: Float
    start_scores: Float
    n_scored: int


def refine_directions(
    scorer: Scorer,
    locations: ArrayLike,
    axes: ArrayLike,
    max_angle_deg: float = 10.0,
    first_step_deg: float = 4.0,
    last_step_deg: float = 0.25,
) -> RefinedViews:
    """Improve axes by a pattern search on the sphere (Hooke and Jeeves 1961; compass search, Kolda et al. 2003).

    Eight axes one step away from the current one are scored; the best of them replaces it if it scores higher,
    otherwise the step is halved, until it falls below the last. All views are searched together, so that the scorer
    gets batches. Scores need not be continuous.

    The search begins at locations (B, 3) m with axes (B, 3) of any length, such as the best of a lattice. The default
    `max_angle_deg` from there exceeds the distance of neighbours on a lattice of 500 directions; about half that
    distance works well as the first step. Raises ValueError if locations or axes are not finite, have no length or
    differ in number, or an angle is not positive.
    """
    if not (max_angle_deg > 0 and first_step_deg > 0 and last_step_deg > 0):
        raise ValueError("angles must be positive")
    at, start = (np.asarray(values, dtype=np.float64).reshape(-1, 3) for values in (locations, axes))
    start_scores = scorer.score(poses_looking_along(at, start))  # raises on what is not finite
    start = start / np.linalg.norm(start, axis=1, keepdims=True)
    current = start.copy()
    step_deg = np.full(len(start), float(min(first_step_deg, max_angle_deg)))
    scores = start_scores.copy()
    n_scored = len(start)
    while len(active := np.flatnonzero(step_deg >= last_step_deg)):
        candidates = _neighbour_directions(current[active], step_deg[active])
        candidates = _within(candidates, start[active, None], max_angle_deg)
        values = scorer.score(poses_looking_along(np.repeat(at[active], 8, axis=0), candidates.reshape(-1, 3)))
        n_scored += len(values)
        values = values.reshape(-1, 8)
        best = values.argmax(axis=1)
        value = values[np.arange(len(active)), best]
        better = value > scores[active]
        moved = active[better]
        current[moved] = candidates[better, best[better]]
        scores[moved] = value[better]
        step_deg[active[~better]] /= 2
    return RefinedViews(current, scores, start_scores, n_scored)


def _neighbour_directions(axes: Float, step_deg: Float) -> Float:
    """Return eight unit vectors (B, 8, 3) at angles of `step_deg` (B,) around axes (B, 3)."""
    u = np.cross(axes, np.eye(3)[np.abs(axes).argmin(axis=1)])  # with a coordinate axis that is not parallel
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    angle = np.radians(step_deg)[:, None, None]
    across = COMPASS[:, :1] * u[:, None] + COMPASS[:, 1:] * np.cross(axes, u)[:, None]
    return np.asarray(np.cos(angle) * axes[:, None] + np.sin(angle) * across)


def _within(candidates: Float, start: Float, max_angle_deg: float) -> Float:
    """Move candidates (B, 8, 3) that are too far from their start (B, 1, 3) back to the limit."""
    outside = angles_to_axis_deg(candidates, start)[..., None] > max_angle_deg
    limit = np.radians(max_angle_deg)
    across = candidates - (candidates * start).sum(-1, keepdims=True) * start
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
    return np.where(outside, np.cos(limit) * start + np.sin(limit) * across, candidates)
