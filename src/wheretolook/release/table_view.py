"""The paper's tables for notebooks: our numbers with their intervals beside the printed ones."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pandas as pd

from wheretolook.evaluation.paper_tables import KEYS
from wheretolook.evaluation.scores import RELEASED_DIVISOR
from wheretolook.utils.tracking import TrackingConfig, newest_artifact
from wheretolook.viewpoints.thresholds import threshold_label

if TYPE_CHECKING:
    from pandas.io.formats.style import Styler

DIVIDED = f"/{RELEASED_DIVISOR}"
"""Name of the column of shares divided by the released code's constant."""


def latest_paper_table(tracking: TrackingConfig, name: str, dataset: str = "") -> pd.DataFrame:
    """A table of `wheretolook.evaluation.paper_tables.paper_tables` from the newest evaluation in a store.

    Args:
        tracking: the store.
        name: "vs_others" or "input_variants".
        dataset: that was evaluated; "" for any.

    Raises:
        MissingRunError: there is none.
    """
    return pd.read_csv(newest_artifact(tracking, "evaluate", f"table_{name}.csv", dataset))


def paper_cells(table: pd.DataFrame) -> pd.DataFrame:
    """A table of `wheretolook.evaluation.paper_tables.paper_tables` as text.

    Returns:
        A row for each of the paper's, by its name there and its name here; for each threshold the columns "ours" (% of
        the oracle's share), "95 %" (its interval), "/0.527" and "paper", a dash where there is no number.
    """
    columns = {}
    for key in KEYS:
        low, high = table[f"score_low_{key}"], table[f"score_high_{key}"]
        wide = low < high
        columns[threshold_label(key), "ours"] = table[f"score_{key}"].map(_one)
        columns[threshold_label(key), "95 %"] = (low.map(_one) + " – " + high.map(_one)).where(wide, "")
        columns[threshold_label(key), DIVIDED] = table[f"released_{key}"].map(_one)
        columns[threshold_label(key), "paper"] = table[f"paper_{key}"].map(_one)
    cells = pd.DataFrame(columns)
    cells.index = pd.MultiIndex.from_frame(table[["paper_row", "method"]], names=["paper", "here"])
    return cells


def paper_styler(table: pd.DataFrame) -> Styler:
    """`paper_cells` for a notebook: the best of ours and of the paper's bold, what only explains in grey."""
    cells = paper_cells(table)
    bold = pd.DataFrame("", index=cells.index, columns=cells.columns)
    for key in KEYS:
        for source, name in ((f"score_{key}", "ours"), (f"paper_{key}", "paper")):
            values = table[source].to_numpy()
            bold.loc[values == table[source].max(), (threshold_label(key), name)] = "font-weight: bold"
        bold[threshold_label(key), "95 %"] = bold[threshold_label(key), DIVIDED] = "color: #777777; font-size: 85%"
    return (
        cells.style.apply(lambda _: bold, axis=None)
        .set_table_styles([
            {"selector": "td", "props": "text-align: right; white-space: nowrap; padding: 2px 6px"},
            {"selector": "th", "props": "text-align: left; white-space: nowrap; font-weight: normal; padding: 2px 6px"},
            {"selector": "th.col_heading", "props": "text-align: center; font-weight: bold"},
        ])
    )  # fmt: skip


def _one(value: float) -> str:
    return "–" if pd.isna(value) else f"{value:.1f}"
