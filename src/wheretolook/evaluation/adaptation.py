"""Whether a scorer that was adapted to a place is better there, by views that it has not learnt from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit
from sklearn.metrics import roc_auc_score

from wheretolook.evaluation.bootstrap import ClusterBootstrap
from wheretolook.evaluation.calibration import expected_calibration_error
from wheretolook.geometry.poses import Float
from wheretolook.scorers.adapted.gp_correction import log_losses
from wheretolook.utils.markdown import markdown_table

RESAMPLES = 2000
NEIGHBOURS_M = 1.0  # locations in one square of the floor of this side are resampled together


@dataclass(frozen=True)
class Gain:
    """What adapting has changed; intervals are of 95 % over locations, neighbours resampled together, or over
    blocks of photographs.

    `before` and `after` have log loss, AUC, regret in percentage points and expected calibration error, by name.
    """

    before: dict[str, float]
    after: dict[str, float]
    log_loss_less: tuple[float, float, float]  # how much less the log loss is, and the interval
    regret_less: tuple[float, float, float]  # likewise regret

    @property
    def is_better(self) -> bool:
        """Whether the chances are truer by more than the interval, and views are not chosen worse by more than it."""
        return self.log_loss_less[1] > 0 and not self.regret_less[2] < 0

    @property
    def is_worse(self) -> bool:
        """Whether the chances are less true, or views are chosen worse, by more than the interval."""
        return self.log_loss_less[2] < 0 or self.regret_less[2] < 0


def compare_log_odds(
    before: Float,
    after: Float,
    good: NDArray[np.bool_],
    location: NDArray[np.integer],
    centers: Float,
    seed: int = 0,
    blocks: NDArray[np.integer] | None = None,
) -> Gain:
    """Compare log-odds (B,) of views that localize or not (B,), at locations by number (B,), of cameras (B, 3) m.

    Of regret the locations count that have several views. Photographs of a block (`blocks` (B,), -1 for views that are
    none) are resampled together, and a location of theirs lies in one block.
    """
    ids, row, times = np.unique(location, return_inverse=True, return_counts=True)
    row = row.reshape(-1)
    first = np.unique(row, return_index=True)[1]
    squares = np.unique(np.floor(centers[first, :2] / NEIGHBOURS_M), axis=0, return_inverse=True)[1].reshape(-1)
    if blocks is not None:
        squares = np.where(blocks[first] >= 0, squares.max() + 1 + blocks[first], squares)
    bootstrap = ClusterBootstrap(squares, RESAMPLES, seed)

    def less(values: Float, counts: Float) -> tuple[float, float, float]:
        low, high = bootstrap.ratio_interval(values[:, None], counts[:, None])
        return float(values.sum() / max(1e-12, counts.sum())), float(low[0]), float(high[0])

    def missed(log_odds: Float) -> Float:
        """Of each location, 1 if a good view was there to choose and the first one chosen is none."""
        order = np.lexsort((-log_odds, row))
        chosen = order[np.flatnonzero(np.diff(row[order], prepend=-1))]
        possible = np.zeros(len(ids), dtype=bool)
        np.logical_or.at(possible, row, good)
        return (possible & ~good[chosen]).astype(np.float64) * (times > 1)

    choice = np.asarray(times > 1, dtype=np.float64)
    both = (before, after)
    losses = [log_losses(z, good) for z in both]
    misses = [missed(z) for z in both]
    told = []
    for z, loss, miss in zip(both, losses, misses, strict=True):
        auc = float(roc_auc_score(good, z)) if 0 < good.sum() < len(good) else float("nan")
        regret = 100 * float(miss.sum() / max(1.0, choice.sum()))
        error = expected_calibration_error(expit(z), good)
        told.append({"log_loss": float(loss.mean()), "auc": auc, "regret": regret, "calibration_error": error})
    changed = np.bincount(row, weights=losses[0] - losses[1]).astype(np.float64)
    loss_less = less(changed, times.astype(np.float64))
    return Gain(told[0], told[1], loss_less, less(100 * (misses[0] - misses[1]), choice))


def gain_markdown(gain: Gain) -> str:
    """A gain as a table."""
    names = {"regret": "regret", "auc": "AUC", "calibration_error": "calibration error", "log_loss": "log loss"}
    rows = []
    for key, text in names.items():
        digits = ".1f" if key == "regret" else ".3f"
        rows.append([text, format(gain.before[key], digits), format(gain.after[key], digits)])
    loss = gain.log_loss_less
    regret = gain.regret_less
    if np.isnan(regret[1]):
        less = (
            f"Log loss is less by {loss[0]:.3f} [{loss[1]:.3f}, {loss[2]:.3f}]; there is no choice to judge regret by."
        )
        return f"{markdown_table(('', 'before', 'adapted'), rows)}\n\n{less}\n"
    less = (
        f"Log loss is less by {loss[0]:.3f} [{loss[1]:.3f}, {loss[2]:.3f}], regret by {regret[0]:+.1f} points "
        f"[{regret[1]:+.1f}, {regret[2]:+.1f}]."
    )
    return f"{markdown_table(('', 'before', 'adapted'), rows)}\n\n{less}\n"
