"""Adapt a scorer to a scene by a Gaussian process over poses, as well as by calibration.

The log-odds of a view become scale * log-odds + offset + g(pose), where g is a Gaussian process over poses with the
kernel `nearness` (Rasmussen and Williams, "Gaussian Processes for Machine Learning",
2006, Sec. 3.4: binary classification by the Laplace approximation and Newton's method). It corrects the scorer where it
was wrong at nearby views; far from localized views g is 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree
from scipy.special import expit

from wheretolook.geometry.poses import Float
from wheretolook.scorers.adapted.calibration import MIN_SCALE, PRIOR, LocalizedViews, calibrate, log_losses, splits

LENGTHS_M = (0.5, 1.0, 2.0)
AMPLITUDES = (1.0, 3.0)
SHARPNESS = 4.0
"""Kernels that are tried: lengths, and variances of g. Chosen on the val scenes of configs/cameras.yaml, as was the
sharpness."""
MAX_SUPPORT = 2000  # views that support g, finally and while kernels are tried; evenly spread
TRIED_SUPPORT = 800
REACH = 4.0  # lengths beyond which the kernel, below 4e-4, is cut to zero
STEPS = 30  # of Newton's method at most
TOLERANCE = 1e-4  # smallest gain in log-likelihood of a step

Kernel = tuple[float, float]  # length in metres and variance of g


def nearness(
    centers: Float, axes: Float, other_centers: Float, other_axes: Float, length_m: float, sharpness: float
) -> Float:
    """Return the kernel (B, N) between views (B, 3) m and (N, 3) m with unit optical axes, 1 for the same view.

    A Gaussian of the distance between the cameras, with standard deviation `length_m`, times a von Mises-Fisher kernel
    of the angle between their axes, exp(sharpness (cos - 1)); 0 beyond `REACH` lengths.
    """
    squared = ((centers[:, None] - other_centers[None]) ** 2).sum(-1) / length_m**2
    kernel = np.exp(-squared / 2 + sharpness * (axes @ other_axes.T - 1))
    return np.where(squared <= REACH**2, kernel, 0.0)


class Correction:
    """The sum over N views of their weights (N,), each times its kernel with the query view."""

    def __init__(self, centers: Float, axes: Float, weights: Float, length_m: float, sharpness: float) -> None:
        self.centers = centers
        self.axes = axes
        self.weights = weights
        self.length_m = length_m
        self.sharpness = sharpness
        self._tree = cKDTree(centers)

    def at(self, centers: Float, axes: Float) -> Float:
        """Return the correction (B,) of views at centers (B, 3) m with optical axes (B, 3)."""
        values = np.zeros(len(centers))
        locations, row, counts = np.unique(centers, axis=0, return_inverse=True, return_counts=True)
        rows_by_location = np.split(np.argsort(row.reshape(-1), kind="stable"), np.cumsum(counts)[:-1])
        for location, rows in zip(locations, rows_by_location, strict=False):
            values[rows] = self._at_location(location, axes[rows])
        return values

    def _at_location(self, location: Float, axes: Float) -> Float:
        near = np.array(self._tree.query_ball_point(location, REACH * self.length_m), dtype=np.int64)
        squared = ((self.centers[near] - location) ** 2).sum(1) / self.length_m**2
        by_distance = self.weights[near] * np.exp(-squared / 2)
        return np.asarray(np.exp(self.sharpness * (axes @ self.axes[near].T - 1)) @ by_distance)


@dataclass(frozen=True, eq=False)
class Adaptation:
    """Calibration and correction of log-odds; without support views, calibration only."""

    scale: float
    offset: float
    length_m: float
    sharpness: float
    centers: Float  # (N, 3)
    axes: Float  # (N, 3)
    weights: Float  # (N,)

    def log_odds(self, views: LocalizedViews) -> Float:
        """Return adapted log-odds (B,)."""
        correction = Correction(self.centers, self.axes, self.weights, self.length_m, self.sharpness)
        return self.scale * views.log_odds + self.offset + correction.at(views.centers, views.axes)


def fit(
    views: LocalizedViews, length_m: float, amplitude: float, sharpness: float = SHARPNESS, limit: int = MAX_SUPPORT
) -> Adaptation:
    """Return the most likely adaptation of views for a kernel of this length and variance; 0 calibrates only.

    At most `limit` views support the correction, evenly spread.
    """
    if amplitude and len(views) > limit:
        views = views.rows(np.arange(limit, dtype=np.int64) * len(views) // limit)
    if not amplitude or not len(views):
        scale, offset = calibrate(views)
        return Adaptation(scale, offset, length_m, sharpness, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    y = views.good.astype(np.float64)
    fixed = np.column_stack([views.log_odds, np.ones(len(views))])
    poses = views.centers, views.axes
    kernel = amplitude * nearness(*poses, *poses, length_m, sharpness)
    residual = _most_likely(fixed @ (1.0, 0.0), kernel + (fixed / PRIOR) @ fixed.T, y)
    scale, offset = (1.0, 0.0) + fixed.T @ residual / PRIOR
    return Adaptation(max(float(scale), MIN_SCALE), float(offset), length_m, sharpness, *poses, amplitude * residual)


def _most_likely(mean: Float, covariance: Float, y: Float) -> Float:
    """Return the residual a (N,) that maximizes the posterior of log-odds mean + covariance a, given labels (N,).

    Newton's method (Rasmussen and Williams, Algorithm 3.1), whose steps are cut in two until they gain.
    """

    def objective(a: Float, shift: Float) -> float:
        return float(-a @ shift / 2 - np.logaddexp(0.0, np.where(y > 0, -1.0, 1.0) * (mean + shift)).sum())

    a = np.zeros(len(y))
    shift = np.zeros(len(y))
    known = objective(a, shift)
    for _ in range(STEPS):
        p = expit(mean + shift)
        root = np.sqrt(p * (1 - p))
        target = root**2 * shift + y - p
        factor = cho_factor(np.eye(len(y)) + root[:, None] * covariance * root, check_finite=False)
        best = target - root * cho_solve(factor, root * (covariance @ target), check_finite=False)
        step = best - a
        step_shift = covariance @ best - shift
        size = 1.0
        while (gain := objective(a + size * step, shift + size * step_shift) - known) < 0 and size > 1e-4:
            size /= 2
        a = a + size * step
        shift = shift + size * step_shift
        known = known + gain
        if gain < TOLERANCE:
            break
    return a


@dataclass(frozen=True, eq=False)
class Adapted:
    """An adaptation, and its held-out predictions."""

    adaptation: Adaptation
    length_m: float  # of the kernel that was chosen
    amplitude: float  # its variance; 0 where calibration alone was as good
    held_out: Float  # (B,) log-odds of each view, adapted without its fold


def adapt(views: LocalizedViews, seed: int = 0) -> Adapted:
    """Adapt with the kernel of least held-out log loss in cross-validation; photographs alone calibrate only."""
    parts = list(splits(views, seed))

    def held_out(kernel: Kernel, limit: int = MAX_SUPPORT) -> Float:
        log_odds = np.zeros(len(views))
        for out, training in parts:
            log_odds[out] = fit(training, *kernel, limit=limit).log_odds(views.rows(out))
        return log_odds

    best: Kernel = (1.0, 0.0)
    if (views.photograph < 0).any():
        kernels = [best, *product(LENGTHS_M, AMPLITUDES)]
        best = min(kernels, key=lambda kernel: log_losses(held_out(kernel, TRIED_SUPPORT), views.good).mean())
    return Adapted(fit(views, *best), *best, held_out(best))
