"""Adapting a scorer to a place: how its log-odds are calibrated and corrected there, by views that were localized.

The log-odds of a view become scale * log-odds + offset + g(pose), where g is a Gaussian process over poses with the
kernel of `wheretolook.scorers.adapted.kernel` (Rasmussen and Williams, "Gaussian Processes for Machine Learning",
2006, Sec. 3.4: binary classification by the Laplace approximation, found by Newton's method). So a place is told where
the scorer was wrong nearby, as where it resembles another; far from localized views g is 0.
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
    """B views of a place: what a scorer thought of each, and whether it localized."""

    log_odds: Float  # (B,) of the scorer to be adapted
    good: NDArray[np.bool_]  # (B,)
    centers: Float  # (B, 3) m, cameras in the map's frame
    axes: Float  # (B, 3) unit optical axes
    group: NDArray[np.int64]  # (B,) views of a group are never learnt from and judged by at once: of a location, say
    # (B,) number of the photograph that a view is, as one may be left out with several blocks; -1 for rendered views
    photograph: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    # (B,) number of the place that a view is at: of its views one is chosen; the group where it is not given
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
        """Number of the block that each photograph was left out with (B,), -1 for rendered views."""
        return np.where(self.photograph >= 0, self.group, -1)

    def rows(self, rows: NDArray[np.integer] | NDArray[np.bool_]) -> LocalizedViews:
        """Some of the views."""
        return LocalizedViews(*(getattr(self, part.name)[rows] for part in fields(self)))

    def joined(self, other: LocalizedViews) -> LocalizedViews:
        """These views and others of the same place, whose groups and places are others than these."""
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
    """How log-odds change at a place; without support they are calibrated only."""

    scale: float
    offset: float
    length_m: float
    sharpness: float
    centers: Float  # (N, 3)
    axes: Float  # (N, 3)
    weights: Float  # (N,)

    def log_odds(self, views: LocalizedViews) -> Float:
        """Adapted log-odds (B,)."""
        found = self.scale * views.log_odds + self.offset
        if len(self.weights):
            correction = Correction(self.centers, self.axes, self.weights, self.length_m, self.sharpness)
            found = found + correction.at(views.centers, views.axes)
        return found


def fit(
    views: LocalizedViews, length_m: float, amplitude: float, sharpness: float = SHARPNESS, most: int = MAX_SUPPORT
) -> Adaptation:
    """The adaptation that views make most likely, with a kernel of this length and variance; 0 calibrates only."""
    learnt = evenly(views, most) if amplitude else views
    y = learnt.good.astype(np.float64)
    fixed = np.column_stack([learnt.log_odds, np.ones(len(learnt))])
    if not amplitude or not len(learnt):
        scale, offset = _calibration(fixed, y)
        return Adaptation(scale, offset, length_m, sharpness, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    poses = learnt.centers, learnt.axes
    kernel = amplitude * nearness(*poses, *poses, length_m, sharpness)
    residual = _most_likely(fixed @ (1.0, 0.0), kernel + (fixed / PRIOR) @ fixed.T, y)
    scale, offset = (1.0, 0.0) + fixed.T @ residual / PRIOR
    return Adaptation(float(scale), float(offset), length_m, sharpness, *poses, amplitude * residual)


def _most_likely(mean: Float, covariance: Float, y: Float) -> Float:
    """The residual a (N,) for which log-odds mean + covariance a are the most likely, of labels (N,).

    Newton's method (Rasmussen and Williams, Algorithm 3.1), whose steps are halved until they gain.
    """

    def worth(a: Float, shift: Float) -> float:
        return float(-a @ shift / 2 - np.logaddexp(0.0, np.where(y > 0, -1.0, 1.0) * (mean + shift)).sum())

    a = np.zeros(len(y))
    shift = np.zeros(len(y))
    known = worth(a, shift)
    for _ in range(STEPS):
        p = expit(mean + shift)
        root = np.sqrt(p * (1 - p))
        target = root**2 * shift + y - p
        factor = cho_factor(np.eye(len(y)) + root[:, None] * covariance * root, check_finite=False)
        full = target - root * cho_solve(factor, root * (covariance @ target), check_finite=False)
        step = 1.0
        full_shift = covariance @ full
        while (gained := worth(a + step * (full - a), shift + step * (full_shift - shift)) - known) < 0 and step > 1e-4:
            step /= 2
        a = a + step * (full - a)
        shift = shift + step * (full_shift - shift)
        known = known + gained
        if gained < TOLERANCE:
            break
    return a


def _calibration(fixed: Float, y: Float) -> tuple[float, float]:
    """Scale and offset of log-odds (Platt scaling), with their prior."""
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
    """At most so many of the views, evenly spread over their order."""
    if len(views) <= most:
        return views
    return views.rows(np.arange(most, dtype=np.int64) * len(views) // max(most, 1))


def folds_of(group: NDArray[np.int64], count: int = FOLDS, seed: int = 0) -> NDArray[np.int64]:
    """A fold (B,) of each view; groups stay together."""
    names, row = np.unique(group, return_inverse=True)
    order = np.random.default_rng(seed).permutation(len(names))
    return np.asarray(order[row.reshape(-1)] % min(count, max(2, len(names))))


@dataclass(frozen=True, eq=False)
class Adapted:
    """The adaptation to a place, and what it gave for views that it had not learnt from."""

    adaptation: Adaptation
    length_m: float  # of the kernel that was chosen
    amplitude: float  # its variance; 0 where calibration alone was as good
    held_out: Float  # (B,) log-odds of each view, by what was learnt without its fold


def adapt(views: LocalizedViews, seed: int = 0) -> Adapted:
    """Adapt by cross-validation: the kernel with the least log loss over views that were not learnt from.

    Photographs alone calibrate only: they are few, and a correction by pose was no better for blocks that were not
    learnt from (docs/adapt.md), while calibration leaves the order of a map's views as it is.
    """
    rendered = (views.photograph < 0).any()
    best = _choose_kernel(views, seed) if rendered else (1.0, 0.0)
    found = np.zeros(len(views))
    for out, learnt in splits(views, seed):
        found[out] = fit(learnt, *best).log_odds(views.rows(out))
    return Adapted(fit(views, *best), *best, found)


def splits(views: LocalizedViews, seed: int = 0) -> Iterator[tuple[NDArray[np.bool_], LocalizedViews]]:
    """Views to judge by (B,), each once, and those to learn from then.

    Locations are judged by in `FOLDS` parts; where there are photographs alone, one block after the other. Photographs
    that are judged by are not learnt from, in whatever block they are.
    """
    rendered = (views.photograph < 0).any()
    fold = folds_of(views.group, FOLDS if rendered else len(views), seed)
    for number in np.unique(fold):
        out = fold == number
        again = (views.photograph >= 0) & np.isin(views.photograph, views.photograph[out])
        yield out, views.rows(~out & ~again)


def _choose_kernel(views: LocalizedViews, seed: int) -> tuple[float, float]:
    """Length and variance of the kernel that is the best for views that were not learnt from."""
    parts = list(splits(views, seed))

    def loss(kernel: tuple[float, float]) -> float:
        found = np.zeros(len(views))
        for out, learnt in parts:
            found[out] = fit(learnt, *kernel, most=TRIED_SUPPORT).log_odds(views.rows(out))
        return float(log_losses(found, views.good).mean())

    return min([(1.0, 0.0), *product(LENGTHS_M, AMPLITUDES)], key=loss)


def log_losses(log_odds: Float, good: NDArray[np.bool_]) -> Float:
    """Negative log-likelihood (B,) of whether each view localizes."""
    return np.asarray(np.logaddexp(0.0, np.where(good, -log_odds, log_odds)))
