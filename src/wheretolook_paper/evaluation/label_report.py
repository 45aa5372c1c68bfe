"""Reports on the labels of a dataset: class balance, pose errors, and dependence on thresholds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from wheretolook.dataset.config import THRESHOLDS, threshold_key, threshold_label
from wheretolook.dataset.viewpoint_table import FIRST, LOCALIZED, NO_POSE, POSITIVE, TOO_FEW_MATCHES, label_shares
from wheretolook.geometry.poses import Float
from wheretolook.utils.texts import markdown_table

BINS_PER_DECADE = 5
ERROR_EDGES_M = np.logspace(-4, 2, 6 * BINS_PER_DECADE + 1)
ERROR_EDGES_DEG = np.logspace(-3, 2.4, 27 + 1)
"""Edges of the error histograms, metres and degrees. Errors beyond an end count in the last bin there."""

VISIBLE_EDGES = (0, 1, 10, 30, 100, 300, 1000, 3000, np.inf)
"""Edges of the bands of the number of visible landmarks."""

HEIGHT_BANDS_M = (0.5, 1.0, 2.0, 5.0, 10.0)
MAX_HEIGHT_BANDS = 7
"""Possible widths of a height band; the narrowest with at most this many bands is used."""

LABELS = tuple(threshold_label(threshold_key(threshold)) for threshold in THRESHOLDS)
"""The thresholds as text, from the finest to the coarsest."""


@dataclass(frozen=True, eq=False)
class LabelSummary:
    """Statistics of the labels of a dataset. Every share is in [0, 1].

    Attributes:
        shares: see `label_shares`.
        by_height: one row for each band of the camera's height above its scene's lowest location: `low`, `high` in
            metres, `n_views`, shares of positives. Bands within the range may be empty.
        by_visible: the same by the number of landmarks in view; `high` is exclusive, infinite in the last.
        errors_m: one row for each bin of the position error: `low`, `high` in metres, and the number of viewpoints with
            such an error whose pose was `localized` or `disbelieved` (with too few inliers: status "no_pose").
        errors_deg: the same of the rotation error, in degrees.
    """

    shares: pd.DataFrame
    by_height: pd.DataFrame
    by_visible: pd.DataFrame
    errors_m: pd.DataFrame
    errors_deg: pd.DataFrame

    @property
    def overall(self) -> dict[str, Any]:
        """The row of `shares` over all scenes."""
        return {str(name): value for name, value in self.shares.iloc[-1].items()}


def label_summary(views: pd.DataFrame) -> LabelSummary:
    """Summarize the labels of scenes, `pooled_labels` with at least one row."""
    height = views["height_m"].to_numpy()
    width = next((w for w in HEIGHT_BANDS_M if height.max() < w * MAX_HEIGHT_BANDS), HEIGHT_BANDS_M[-1])
    return LabelSummary(
        shares=label_shares(views),
        by_height=_by_band(views, height, width * np.arange(height.max() // width + 2)),
        by_visible=_by_band(views, views["n_visible"].to_numpy(), np.array(VISIBLE_EDGES)),
        errors_m=_histogram(views, "error_m", ERROR_EDGES_M),
        errors_deg=_histogram(views, "error_deg", ERROR_EDGES_DEG),
    )


def _by_band(views: pd.DataFrame, values: Float, edges: Float) -> pd.DataFrame:
    """Views and positives of each band, from the first to the last that is not empty. No value is beyond the edges."""
    band = np.digitize(values, edges) - 1
    kept = np.arange(band.min(), band.max() + 1)
    by_band = views.groupby(band)
    bands = pd.DataFrame({"low": edges[kept], "high": edges[kept + 1]}, index=kept)
    bands["n_views"] = by_band.size().reindex(kept, fill_value=0)
    return bands.join(by_band[list(POSITIVE)].mean()).reset_index(drop=True)


def _histogram(views: pd.DataFrame, column: str, edges: Float) -> pd.DataFrame:
    counts = {}
    localized = views["status"] == LOCALIZED
    for name, rows in (("localized", localized), ("disbelieved", ~localized)):
        error = views.loc[rows, column].dropna().to_numpy(np.float64)
        bins = np.clip(np.digitize(error, edges) - 1, 0, len(edges) - 2)
        counts[name] = np.bincount(bins, minlength=len(edges) - 1)
    return pd.DataFrame({"low": edges[:-1], "high": edges[1:], **counts})


def threshold_sentence(summary: LabelSummary) -> str:
    """A sentence on how much the labels depend on the threshold, from the numbers over all scenes."""
    row = summary.overall
    coarsest = row[POSITIVE[-1]]
    if not coarsest:
        return f"No viewpoint is within {LABELS[-1]}: all are negative at every threshold."
    finer = [
        f"{_percent(row[name] / coarsest)} % are within {label}"
        for name, label in zip(POSITIVE[:-1], LABELS[:-1], strict=True)
    ]
    errors = f"Their median errors are {_median_error(row, 'within')}"
    if pd.notna(row["median_beyond_m"]):
        errors += f"; those of the other poses are {_median_error(row, 'beyond')}"
    return (
        f"{_percent(row['same_label_share'])} % of the viewpoints have the same label at all {len(POSITIVE)} "
        f"thresholds. Of those within {LABELS[-1]}, {', '.join(finer)}. {errors}."
    )


def label_markdown(summary: LabelSummary, title: str = "Labels") -> str:
    """The summary as Markdown tables, under a title and `threshold_sentence`."""
    row = summary.overall
    positives = dict(zip(LABELS, POSITIVE, strict=True))
    shares = summary.shares.assign(
        spearman=[f"{value:.2f}".replace("nan", "–") for value in summary.shares["spearman"]]
    )
    columns = {"scene": "scene", "split": "split", "views": "n_views", "locations": "n_locations", **positives}
    columns |= {"locations with a positive": "locations_positive"}
    columns |= {"localized": LOCALIZED, "too few matches": TOO_FEW_MATCHES, "no pose": NO_POSE}
    columns |= {"finest of coarsest": "finest_of_coarsest", "same label": "same_label_share", "Spearman": "spearman"}
    bands = {"views": "n_views", **positives}
    heights = [f"{low:g}–{high:g}" for low, high in summary.by_height[["low", "high"]].to_numpy()]
    visible = [_visible_label(low, high) for low, high in summary.by_visible[["low", "high"]].to_numpy()]
    sections = [
        f"# {title}",
        threshold_sentence(summary),
        f"{row['n_views']:,} viewpoints at {row['n_locations']:,} locations; shares in % of viewpoints. Positive at "
        f"a threshold: localized with both errors under its limits; the label is that at the first, {LABELS[0]}, and a "
        "location with a positive has a viewpoint with this label. Finest of coarsest: how many of the last "
        "threshold's positives are positive at the first. Same label: equal at all thresholds. Spearman: the rank "
        "correlation of the first and the last label.",
        _table(shares, columns),
        *_first_table(summary),
        "## By height of the camera above its scene's lowest location",
        _table(summary.by_height.assign(band=heights), {"height (m)": "band", **bands}),
        "## By number of visible landmarks",
        _table(summary.by_visible.assign(band=visible), {"visible landmarks": "band", **bands}),
        "## Errors of the estimated poses",
        f"In % of all viewpoints; {_percent(row['without_pose'])} % have no pose at all. Disbelieved poses have too "
        "few inliers and count as not localized. Errors beyond the first and the last row count there.",
        _error_table("position error (m)", summary.errors_m, row["n_views"]),
        _error_table("rotation error (°)", summary.errors_deg, row["n_views"]),
    ]
    return "\n\n".join(sections) + "\n"


def _first_table(summary: LabelSummary) -> list[str]:
    """Section on the labels by the first RANSAC result, if there are any."""
    if f"{FIRST}{POSITIVE[0]}" not in summary.shares:
        return []
    columns = {label: f"{FIRST}{name}" for label, name in zip(LABELS, POSITIVE, strict=True)}
    about = "Shares in %, where those above are by the best of several hypotheses."
    table = _table(summary.shares, {"scene": "scene", "split": "split", **columns})
    return ["## By the first RANSAC result", about, table]


def _visible_label(low: float, high: float) -> str:
    """Name of a band of visible landmarks from `low` to `high`, exclusive."""
    if np.isinf(high):
        return f"≥ {low:,.0f}"
    return f"{low:,.0f}" if high == low + 1 else f"{low:,.0f}–{high - 1:,.0f}"


def _error_table(title: str, errors: pd.DataFrame, n_views: int) -> str:
    """Histogram bins, summed by decades."""
    decades = errors.groupby(np.arange(len(errors)) // BINS_PER_DECADE)
    lows = decades["low"].first().tolist()
    names = [f"{low:g}–{high:g}" for low, high in pairwise(lows)] + [f"≥ {lows[-1]:g}"]
    shares = decades[["localized", "disbelieved"]].sum() / n_views
    return _table(shares.assign(band=names), {title: "band", "localized": "localized", "disbelieved": "disbelieved"})


def _table(frame: pd.DataFrame, columns: Mapping[str, str]) -> str:
    """Markdown table of a frame's columns by their headers; floating-point numbers are shares."""
    cells = [
        [
            f"{value:,}" if isinstance(value, int) else value if isinstance(value, str) else _percent(value)
            for value in row
        ]
        for row in zip(*(frame[name].tolist() for name in columns.values()), strict=True)
    ]
    return markdown_table([*columns], cells)


def _median_error(row: Mapping[str, Any], name: str) -> str:
    error_m = row[f"median_{name}_m"]
    error_deg = row[f"median_{name}_deg"]
    return f"{length_text(error_m)}, {error_deg:.{2 if error_deg < 1 else 0}f}°"


def length_text(metres: float) -> str:
    """Format a length in mm below 1 cm, in cm below 1 m, else in m."""
    if metres < 0.01:
        return f"{1000 * metres:.1f} mm"
    return f"{100 * metres:.1f} cm" if metres < 1 else f"{metres:.1f} m"


def _percent(share: float) -> str:
    return "–" if np.isnan(share) else f"{100 * share:.1f}"
