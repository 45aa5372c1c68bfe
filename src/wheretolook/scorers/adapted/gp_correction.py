"""Adapt a scorer to a scene: calibrate and correct its log-odds by localized views.

The log-odds of a view become scale * log-odds + offset + g(pose), where g is a Gaussian process over poses with the
kernel of `wheretolook.scorers.adapted.kernel` (Rasmussen and Williams, "Gaussian Processes for Machine Learning",
2006, Sec. 3.4: binary classification by the Laplace approximation and Newton's method). It corrects the scorer where it
was wrong at nearby views; far from localized views g is 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.special import expit

from wheretolook.geometry.poses import Float
from wheretolook.scorers.adapted.kernel import Correction, nearness

LENGTHS_M = (0.5, 1.0, 2.0)
AMPLITUDES = (1.0, 3.0)
SHARPNESS = 4.0
"""Kernels that are tried: lengths, and variances of g. Chosen on the val scenes of configs/cameras.yaml, as was the
sharpness."""
PRIOR = np.array([5.0, 0.1])  # precision of scale (about 1) and offset (about 0)
MAX_SUPPORT = 2000  # views that support g, finally and while kernels are tried; evenly spread
TRIED_SUPPORT = 800
FOLDS = 5
MIN_SCALE = 1e-3  # of log-odds: 0 or less would reverse the order of the views
STEPS = 30  # of Newton's method at most
TOLERANCE = 1e-4  # smallest gain in log-likelihood of a step

Kernel = tuple[float, float]  # length in metres and variance of g


@dataclass(frozen=True, eq=False)
class LocalizedViews:
    """B views of a scene: the log-odds of a scorer, and whether each localized."""

    log_odds: Float  # (B,) of the scorer to be adapted
    good: NDArray[np.bool_]  # (B,)
    centers: Float  # (B, 3) m, cameras in the map's frame
    axes: Float  # (B, 3) unit optical axes
    group: NDArray[np.int64]  # (B,) views of a group, such as a location, are held out together
    # (B,) index of the view's photograph, which may be held out with several blocks; -1 for rendered views
    photograph: NDArray[np.int64]
    place: NDArray[np.int64]  # (B,) index of the view's location, of whose views one is chosen

    @classmethod
    def rendered(
        cls, log_odds: Float, good: NDArray[np.bool_], centers: Float, axes: Float, location: NDArray[np.int64]
    ) -> LocalizedViews:
        """Return rendered views, which are held out by location (B,)."""
        return cls(log_odds, good, centers, axes, location, np.full(len(good), -1), location)

    def __len__(self) -> int:
        return len(self.good)

    @property
    def blocks(self) -> NDArray[np.int64]:
        """Index of the block that each photograph was held out with (B,), -1 for rendered views."""
        return np.where(self.photograph >= 0, self.group, -1)

    def rows(self, rows: NDArray[np.integer] | NDArray[np.bool_]) -> LocalizedViews:
        """Return some of the views."""
        return LocalizedViews(*(getattr(self, part.name)[rows] for part in fields(self)))

    def joined(self, other: LocalizedViews) -> LocalizedViews:
        """Return these views and others of the same scene, with separate groups and locations."""
        parts = []
        for part in fields(self):
            values = getattr(self, part.name)
            shift = int(values.max()) + 1 if part.name in ("group", "place") and len(self) else False
            parts.append(np.concatenate([values, getattr(other, part.name) + shift]))
        return LocalizedViews(*parts)


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
    y = views.good.astype(np.float64)
    fixed = np.column_stack([views.log_odds, np.ones(len(views))])
    if not amplitude or not len(views):
        scale, offset = _calibration(fixed, y)
        return Adaptation(scale, offset, length_m, sharpness, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
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


def _calibration(fixed: Float, y: Float) -> tuple[float, float]:
    """Return scale and offset of log-odds (Platt scaling) with a prior."""
    prior = np.array([1.0, 0.0])

    def loss(at: Float) -> tuple[float, Float]:
        log_odds = fixed @ at
        value = np.logaddexp(0, log_odds).sum() - y @ log_odds + PRIOR @ (at - prior) ** 2 / 2
        return float(value), fixed.T @ (expit(log_odds) - y) + PRIOR * (at - prior)

    scale, offset = minimize(loss, prior, jac=True, bounds=((MIN_SCALE, None), (None, None))).x
    return float(scale), float(offset)


@dataclass(frozen=True, eq=False)
class Adapted:
    """An adaptation, and its held-out predictions."""

    adaptation: Adaptation
    length_m: float  # of the kernel that was chosen
    amplitude: float  # its variance; 0 where calibration alone was as good
    held_out: Float  # (B,) log-odds of each view, adapted without its fold


def adapt(views: LocalizedViews, seed: int = 0) -> Adapted:
    """Adapt with the kernel of least held-out log loss in cross-validation.

    Photographs alone calibrate only: they are few, and a correction by pose did not improve held-out blocks
    (docs/adapt.md).
    """
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


def splits(views: LocalizedViews, seed: int = 0) -> Iterator[tuple[NDArray[np.bool_], LocalizedViews]]:
    """Yield held-out views (B,), each view once, and the training views.

    Groups are held out in `FOLDS` parts; those of photographs alone, one after the other. A held-out photograph is not
    in the training views, whatever its group.
    """
    names, row = np.unique(views.group, return_inverse=True)
    n_folds = FOLDS if (views.photograph < 0).any() else len(views)
    order = np.random.default_rng(seed).permutation(len(names))
    fold = order[row.reshape(-1)] % min(n_folds, max(2, len(names)))
    for number in np.unique(fold):
        out = fold == number
        again = (views.photograph >= 0) & np.isin(views.photograph, views.photograph[out])
        yield out, views.rows(~out & ~again)


def log_losses(log_odds: Float, good: NDArray[np.bool_]) -> Float:
    """Return the negative log-likelihood (B,) of whether each view localizes."""
    return np.asarray(np.logaddexp(0.0, np.where(good, -log_odds, log_odds)))
