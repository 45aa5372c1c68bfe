"""Adapt a scorer to a scene: calibrate and correct its log-odds by localized views.

The log-odds of a view become scale * log-odds + offset + g(pose), where g is a Gaussian process over poses with the
kernel of `wheretolook.scorers.adapted.kernel` (Rasmussen and Williams, "Gaussian Processes for Machine Learning",
2006, Sec. 3.4: binary classification by the Laplace approximation and Newton's method). It corrects the scorer where it
was wrong at nearby views; far from localized views g is 0.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.special import expit

from wheretolook.geometry.poses import Float
from wheretolook.scorers.adapted.kernel import Correction, nearness

LENGTHS_M = (0.5, 1.0, 2.0)
AMPLITUDES = (1.0, 3.0)
SHARPNESS = 4.0
"""Kernels that are tried: lengths, and variances of g. Chosen on the val scenes of configs/cameras.yaml, as was the
sharpness."""
PRIOR = np.array([5.0, 0.1])  # precision of scale (about 1) and offset (about 0)
MAX_SUPPORT = 2000  # views that g stands on, finally and while kernels are tried; evenly spread
TRIED_SUPPORT = 800
FOLDS = 5
STEPS = 30  # of Newton's method: steps at most, and what one gains in log-likelihood at least
TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class LocalizedViews:
    """B views of a scene: the log-odds of a scorer, and whether each localized."""

    log_odds: Float  # (B,) of the scorer to be adapted
    good: NDArray[np.bool_]  # (B,)
    centers: Float  # (B, 3) m, cameras in the map's frame
    axes: Float  # (B, 3) unit optical axes
    group: NDArray[np.int64]  # (B,) views of a group, such as a location, are held out together
    # (B,) index of the view's photograph, which may be held out with several blocks; -1 for rendered views
    photograph: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    # (B,) index of the view's location, of whose views one is chosen; the group by default
    place: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __post_init__(self) -> None:
        if len(self.photograph) != len(self.good):
            object.__setattr__(self, "photograph", np.full(len(self.good), -1))
        if len(self.place) != len(self.good):
            object.__setattr__(self, "place", self.group)

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
        shifts = {"group": 0, "place": 0}
        for name in shifts if len(self) else ():
            shifts[name] = int(getattr(self, name).max()) + 1
        parts = [
            np.concatenate([getattr(self, part.name), getattr(other, part.name) + shifts.get(part.name, False)])
            for part in fields(self)
        ]
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
        found = self.scale * views.log_odds + self.offset
        if len(self.weights):
            correction = Correction(self.centers, self.axes, self.weights, self.length_m, self.sharpness)
            found = found + correction.at(views.centers, views.axes)
        return found


def fit(
    views: LocalizedViews, length_m: float, amplitude: float, sharpness: float = SHARPNESS, most: int = MAX_SUPPORT
) -> Adaptation:
    """Return the most likely adaptation of views for a kernel of this length and variance; 0 calibrates only."""
    training = evenly(views, most) if amplitude else views
    y = training.good.astype(np.float64)
    fixed = np.column_stack([training.log_odds, np.ones(len(training))])
    if not amplitude or not len(training):
        scale, offset = _calibration(fixed, y)
        return Adaptation(scale, offset, length_m, sharpness, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    poses = training.centers, training.axes
    kernel = amplitude * nearness(*poses, *poses, length_m, sharpness)
    residual = _most_likely(fixed @ (1.0, 0.0), kernel + (fixed / PRIOR) @ fixed.T, y)
    scale, offset = (1.0, 0.0) + fixed.T @ residual / PRIOR
    return Adaptation(float(scale), float(offset), length_m, sharpness, *poses, amplitude * residual)


def _most_likely(mean: Float, covariance: Float, y: Float) -> Float:
    """Return the residual a (N,) that maximizes the posterior of log-odds mean + covariance a, given labels (N,).

    Newton's method (Rasmussen and Williams, Algorithm 3.1), whose steps are halved until they gain.
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
        full = target - root * cho_solve(factor, root * (covariance @ target), check_finite=False)
        step = 1.0
        full_shift = covariance @ full
        while (
            gained := objective(a + step * (full - a), shift + step * (full_shift - shift)) - known
        ) < 0 and step > 1e-4:
            step /= 2
        a = a + step * (full - a)
        shift = shift + step * (full_shift - shift)
        known = known + gained
        if gained < TOLERANCE:
            break
    return a


def _calibration(fixed: Float, y: Float) -> tuple[float, float]:
    """Return scale and offset of log-odds (Platt scaling) with a prior."""
    at = np.array([1.0, 0.0])
    prior = np.array([1.0, 0.0])
    for _ in range(STEPS):
        p = expit(fixed @ at)
        gradient = fixed.T @ (p - y) + PRIOR * (at - prior)
        step = np.linalg.solve(fixed.T @ (fixed * (p * (1 - p))[:, None]) + np.diag(PRIOR), gradient)
        at = at - step * min(1.0, 2.0 / max(1e-12, float(np.abs(step).max())))
        if np.abs(step).max() < 1e-8:
            break
    return float(at[0]), float(at[1])


def evenly(views: LocalizedViews, most: int) -> LocalizedViews:
    """Return at most so many of the views, evenly spread over their order."""
    if len(views) <= most:
        return views
    return views.rows(np.arange(most, dtype=np.int64) * len(views) // max(most, 1))


def folds_of(group: NDArray[np.int64], count: int = FOLDS, seed: int = 0) -> NDArray[np.int64]:
    """Return the fold (B,) of each view; groups stay together."""
    names, row = np.unique(group, return_inverse=True)
    order = np.random.default_rng(seed).permutation(len(names))
    return np.asarray(order[row.reshape(-1)] % min(count, max(2, len(names))))


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
    rendered = (views.photograph < 0).any()
    best = _choose_kernel(views, seed) if rendered else (1.0, 0.0)
    found = np.zeros(len(views))
    for out, training in splits(views, seed):
        found[out] = fit(training, *best).log_odds(views.rows(out))
    return Adapted(fit(views, *best), *best, found)


def splits(views: LocalizedViews, seed: int = 0) -> Iterator[tuple[NDArray[np.bool_], LocalizedViews]]:
    """Yield held-out views (B,), each view once, and the training views.

    Locations are held out in `FOLDS` parts; photographs alone, one block after the other. A held-out photograph is not
    in the training views, whatever its block.
    """
    rendered = (views.photograph < 0).any()
    fold = folds_of(views.group, FOLDS if rendered else len(views), seed)
    for number in np.unique(fold):
        out = fold == number
        again = (views.photograph >= 0) & np.isin(views.photograph, views.photograph[out])
        yield out, views.rows(~out & ~again)


def _choose_kernel(views: LocalizedViews, seed: int) -> tuple[float, float]:
    """Return length and variance of the kernel with the least held-out loss."""
    parts = list(splits(views, seed))

    def loss(kernel: tuple[float, float]) -> float:
        found = np.zeros(len(views))
        for out, training in parts:
            found[out] = fit(training, *kernel, most=TRIED_SUPPORT).log_odds(views.rows(out))
        return float(log_losses(found, views.good).mean())

    return min([(1.0, 0.0), *product(LENGTHS_M, AMPLITUDES)], key=loss)


def log_losses(log_odds: Float, good: NDArray[np.bool_]) -> Float:
    """Return the negative log-likelihood (B,) of whether each view localizes."""
    return np.asarray(np.logaddexp(0.0, np.where(good, -log_odds, log_odds)))
