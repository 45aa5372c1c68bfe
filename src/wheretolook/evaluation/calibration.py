"""Calibration of predicted probabilities: reliability curves, expected calibration error, temperature scaling."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import expit

from wheretolook.geometry.poses import Float
from wheretolook.utils.probability import finite_log_odds

Labels = NDArray[np.bool_]  # (B,) whether each view localizes
BINS = 15  # bins of equal width
MARGIN = 1e-15  # probabilities are clipped to this distance from 0 and 1
TEMPERATURES = (0.01, 100.0)  # range of temperatures


def bins_of(probability: Float, bins: int = BINS) -> NDArray[np.int64]:
    """Return the number (B,) of the bin of equal width that holds each probability (B,)."""
    edges = np.linspace(0, 1, bins + 1)
    return np.clip(np.searchsorted(edges, probability, side="right") - 1, 0, bins - 1)


def reliability(probability: Float, good: Labels, bins: int = BINS) -> pd.DataFrame:
    """Compute the reliability curve: the share of views (B,) that localize, by predicted probability (B,).

    One row for each bin of equal width, lower end included, of the last bin also the upper: bin_low, bin_high,
    mean_predicted, share_good (both NaN where the bin is empty) and n (views).
    """
    edges = np.linspace(0, 1, bins + 1)
    rows = bins_of(probability, bins)
    n = np.bincount(rows, minlength=bins)
    curve = pd.DataFrame({"bin_low": edges[:-1], "bin_high": edges[1:]})
    for name, values in (("mean_predicted", probability), ("share_good", good)):
        sums = np.bincount(rows, weights=values, minlength=bins)
        curve[name] = np.divide(sums, n, out=np.full(bins, np.nan), where=n > 0)
    return curve.assign(n=n)


def expected_calibration_error(probability: Float, good: Labels, bins: int = BINS) -> float:
    """Compute the expected calibration error in [0, 1] (Naeini et al., AAAI 2015); NaN without views.

    The mean over the views of the distance between predicted and observed share of their bin in the `reliability` curve.
    """
    if not len(probability):
        return float("nan")
    curve = reliability(probability, good, bins)
    return float((curve["n"] * (curve["mean_predicted"] - curve["share_good"]).abs()).sum() / curve["n"].sum())


def precision_over_coverage(confidence: Float, right: Labels) -> tuple[Float, Float]:
    """Compute the share of right poses among the most confident ones, by the share of the queries that these are.

    Given the confidence (B,) in each query's pose, not finite without a pose, and whether it is right (B,). Returns the
    coverage k / B and the precision (P,) of the k most confident of P poses; equal confidences count as one threshold.
    The mean of the precision over all queries, 0 where there is no pose, is `precision_area` (Arnold et al., ECCV 2022).
    """
    order = np.argsort(-confidence[np.isfinite(confidence)], kind="stable")
    sorted_confidence = confidence[np.isfinite(confidence)][order]
    n_right = np.cumsum(right[np.isfinite(confidence)][order])
    # all poses of the same confidence are accepted together
    last = np.searchsorted(-sorted_confidence, -sorted_confidence, side="right")
    count = np.arange(1, len(order) + 1)
    return count / max(len(confidence), 1), n_right[last - 1] / last


def precision_area(confidence: Float, right: Labels) -> float:
    """Compute the area under `precision_over_coverage` in [0, 1]."""
    return float(precision_over_coverage(confidence, right)[1].sum() / max(len(confidence), 1))


def negative_log_likelihood(probability: Float, good: Labels) -> float:
    """Compute the mean negative log-likelihood of labels (B,) under probabilities (B,), in nats."""
    return _mean_loss(finite_log_odds(probability, MARGIN), good)


def fit_temperature(probability: Float, good: Labels) -> float:
    """Fit the temperature in `TEMPERATURES` that maximizes the likelihood of labels (B,) (Guo et al., ICML 2017).

    It is above 1 for an overconfident network, below 1 for an underconfident one; NaN where all labels are of one class.
    """
    if not len(good) or good.all() or not good.any():
        return float("nan")
    logits = finite_log_odds(probability, MARGIN)

    def loss(log_t: float) -> float:
        return _mean_loss(logits / np.exp(log_t), good)

    best = minimize_scalar(loss, bounds=np.log(TEMPERATURES), method="bounded", options={"xatol": 1e-6})
    return float(np.exp(best.x))


def scale_probability(probability: Float, temperature: float) -> Float:
    """Divide the logits of probabilities (B,) by a temperature; their order stays."""
    return np.asarray(expit(finite_log_odds(probability, MARGIN) / temperature))


def calibration_rows(probability: Float, good: Labels, temperature: float) -> pd.DataFrame:
    """Compute the reliability curve before and, if the temperature is known (not NaN), after scaling.

    Columns: n_views (B), when ("before" or "after"), those of `reliability`, and ece and nll of the whole curve.
    """
    curves = {"before": probability}
    if np.isfinite(temperature):
        curves["after"] = scale_probability(probability, temperature)
    parts = []
    for when, values in curves.items():
        curve = reliability(values, good)
        curve.insert(0, "n_views", len(good))
        curve.insert(1, "when", when)
        ece = expected_calibration_error(values, good)
        parts.append(curve.assign(ece=ece, nll=negative_log_likelihood(values, good)))
    return pd.concat(parts, ignore_index=True)


def _mean_loss(logits: Float, good: Labels) -> float:
    return float(np.mean(np.logaddexp(0, logits) - np.where(good, logits, 0.0)))


def read_calibration(path: Path) -> pd.DataFrame:
    """Read the reliability curves that the evaluate command writes as a CSV file."""
    return pd.read_csv(path, keep_default_na=False, na_values=[""])
