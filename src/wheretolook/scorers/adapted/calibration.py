"""Adapt a scorer to a scene: calibrate its log-odds by localized views (Platt scaling)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit

from wheretolook.geometry.poses import Float

PRIOR = np.array([5.0, 0.1])  # precision of scale (about 1) and offset (about 0)
MIN_SCALE = 1e-3  # of log-odds: 0 or less would reverse the order of the views


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
        parts = {}
        for part in fields(self):
            values = getattr(self, part.name)
            shift = int(values.max()) + 1 if part.name in ("group", "place") and len(self) else False
            parts[part.name] = np.concatenate([values, getattr(other, part.name) + shift])
        return LocalizedViews(**parts)


@dataclass(frozen=True, eq=False)
class Adapted:
    """The calibration scale * log-odds + offset, and its held-out predictions."""

    scale: float
    offset: float
    held_out: Float  # (B,) log-odds of each view, calibrated without its fold


def calibrate(views: LocalizedViews) -> tuple[float, float]:
    """Return the most likely scale and offset of log-odds (Platt scaling) with a prior."""
    prior = np.array([1.0, 0.0])
    fixed = np.column_stack([views.log_odds, np.ones(len(views))])
    y = views.good.astype(np.float64)

    def loss(at: Float) -> tuple[float, Float]:
        log_odds = fixed @ at
        value = np.logaddexp(0, log_odds).sum() - y @ log_odds + PRIOR @ (at - prior) ** 2 / 2
        return float(value), fixed.T @ (expit(log_odds) - y) + PRIOR * (at - prior)

    scale, offset = minimize(loss, prior, jac=True, bounds=((MIN_SCALE, None), (None, None))).x
    return float(scale), float(offset)


def adapt(views: LocalizedViews, seed: int = 0) -> Adapted:
    """Calibrate by all views, and, for held-out predictions, by those of the other folds."""
    held_out = np.zeros(len(views))
    for out, training in splits(views, seed):
        scale, offset = calibrate(training)
        held_out[out] = scale * views.log_odds[out] + offset
    return Adapted(*calibrate(views), held_out)


def splits(views: LocalizedViews, seed: int = 0) -> Iterator[tuple[NDArray[np.bool_], LocalizedViews]]:
    """Yield held-out views (B,), each view once, and the training views.

    Groups are held out in five parts; those of photographs alone, one after the other. A held-out photograph is not
    in the training views, whatever its group.
    """
    names, row = np.unique(views.group, return_inverse=True)
    n_folds = 5 if (views.photograph < 0).any() else len(views)
    order = np.random.default_rng(seed).permutation(len(names))
    fold = order[row.reshape(-1)] % min(n_folds, max(2, len(names)))
    for number in np.unique(fold):
        out = fold == number
        again = (views.photograph >= 0) & np.isin(views.photograph, views.photograph[out])
        yield out, views.rows(~out & ~again)


def log_losses(log_odds: Float, good: NDArray[np.bool_]) -> Float:
    """Return the negative log-likelihood (B,) of whether each view localizes."""
    return np.asarray(np.logaddexp(0.0, np.where(good, -log_odds, log_odds)))
