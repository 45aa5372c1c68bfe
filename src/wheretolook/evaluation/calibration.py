"""Whether a predicted probability means what it says, and one number, the temperature, that makes it mean it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import expit

from wheretolook.geometry.poses import Float
from wheretolook.utils.probability import finite_log_odds

Good = NDArray[np.bool_]  # whether each view localizes, (B,)
BINS = 15  # bins of equal width that probabilities are sorted into
TINY = 1e-15  # probabilities are kept this far from 0 and 1, so that their logits are finite
TEMPERATURES = (0.01, 100.0)  # range in which a temperature is sought


def bins_of(probability: Float, bins: int = BINS) -> NDArray[np.int64]:
    """Number (B,) of the bin of equal width that holds each probability (B,)."""
    edges = np.linspace(0, 1, bins + 1)
    return np.clip(np.searchsorted(edges, probability, side="right") - 1, 0, bins - 1)


def reliability(probability: Float, good: Good, bins: int = BINS) -> pd.DataFrame:
    """The reliability curve: how many of the views that were given about the same probability (B,) are good (B,).

    One row for each bin of equal width, which holds its lower end, the last one 1 as well: bin_low, bin_high,
    mean_predicted, share_good (both NaN where the bin is empty) and n (views).
    """
    edges = np.linspace(0, 1, bins + 1)
    rows = bins_of(probability, bins)
    n = np.bincount(rows, minlength=bins)
    predicted, observed = (np.bincount(rows, weights=values, minlength=bins) for values in (probability, good))
    unknown = np.full((2, bins), np.nan)
    curve = pd.DataFrame({"bin_low": edges[:-1], "bin_high": edges[1:]})
    for name, sums, out in (("mean_predicted", predicted, unknown[0]), ("share_good", observed, unknown[1])):
        curve[name] = np.divide(sums, n, out=out, where=n > 0)
    return curve.assign(n=n)


def expected_calibration_error(probability: Float, good: Good, bins: int = BINS) -> float:
    """Mean over the views of the distance between predicted and observed share of their bin of the `reliability` curve.

    In [0, 1] (Naeini et al., AAAI 2015); NaN without views.
    """
    curve = reliability(probability, good, bins)
    if not len(probability):
        return float("nan")
    return float((curve["n"] * (curve["mean_predicted"] - curve["share_good"]).abs()).sum() / curve["n"].sum())


def negative_log_likelihood(probability: Float, good: Good) -> float:
    """Mean over the views of minus the logarithm of the probability that was given to what happened, in nats."""
    return _mean_loss(finite_log_odds(probability, TINY), good)


def fit_temperature(probability: Float, good: Good) -> float:
    """The temperature under which the observed labels (B,) are most likely (Guo et al., ICML 2017), in `TEMPERATURES`.

    It is above 1 for a network that is too sure, below 1 for one that is not sure enough. NaN where all labels are of
    one class, or there are none: then no temperature is the best.
    """
    if not len(good) or good.all() or not good.any():
        return float("nan")
    logits = finite_log_odds(probability, TINY)
    how: Any = {"bounds": tuple(np.log(TEMPERATURES)), "method": "bounded", "options": {"xatol": 1e-6}}
    best = minimize_scalar(lambda log_t: _mean_loss(logits / np.exp(log_t), good), **how)
    return float(np.exp(best.x))


def scale_probability(probability: Float, temperature: float) -> Float:
    """Probabilities (B,) whose logits are divided by a temperature; their order stays."""
    return np.asarray(expit(finite_log_odds(probability, TINY) / temperature))


def calibration_rows(probability: Float, good: Good, temperature: float) -> pd.DataFrame:
    """The reliability curve before and, if the temperature is known (not NaN), after scaling.

    Columns: n_views (B) and when ("before" or "after"), those of `reliability`, and ece and nll, which are of the whole
    curve.
    """
    curves = {"before": probability}
    if np.isfinite(temperature):
        curves["after"] = scale_probability(probability, temperature)
    parts = []
    for when, values in curves.items():
        about: dict[str, Any] = {"n_views": len(good), "when": when}
        errors = {"ece": expected_calibration_error(values, good), "nll": negative_log_likelihood(values, good)}
        curve = reliability(values, good)
        parts.append(pd.DataFrame({**about, **{str(name): curve[name] for name in curve}, **errors}))
    return pd.concat(parts, ignore_index=True)


def _mean_loss(logits: Float, good: Good) -> float:
    return float(np.mean(np.logaddexp(0, logits) - np.where(good, logits, 0.0)))


def read_calibration(path: Path) -> pd.DataFrame:
    """Reliability curves from the CSV file that the evaluate command writes."""
    return pd.read_csv(path, keep_default_na=False, na_values=[""])
