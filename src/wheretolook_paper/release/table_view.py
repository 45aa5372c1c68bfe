"""The paper's tables for notebooks: this project's numbers with intervals next to the printed ones."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pandas as pd

from wheretolook.dataset.config import threshold_label
from wheretolook.evaluation.results import RELEASED_DIVISOR
from wheretolook.tracking import TrackingConfig, newest_artifact
from wheretolook_paper.evaluation.paper_tables import KEYS

if TYPE_CHECKING:
    from pandas.io.formats.style import Styler

DIVIDED = f"/{RELEASED_DIVISOR}"  # name of the column of shares divided by the released code's constant


def latest_paper_table(tracking: TrackingConfig, name: str, dataset: str = "") -> pd.DataFrame:
    """Read the paper's table "vs_others" or "input_variants" from the newest evaluation of a dataset, or of any ("").

    Raises MissingRunError if there is none.
    """
    return pd.read_csv(newest_artifact(tracking, "evaluate", f"table_{name}.csv", dataset))


def paper_cells(table: pd.DataFrame) -> pd.DataFrame:
    """Format the cells of a table of `paper_tables`.

    A row for each of the paper's methods, by its names there and here; for each threshold the columns "ours" (% of the
    oracle's share), "95 %" (its interval), "/0.527" and "paper", with a dash for missing numbers.
    """
    columns = {}
    for key in KEYS:
        low = table[f"score_low_{key}"]
        high = table[f"score_high_{key}"]
        interval = low.map(_cell) + " – " + high.map(_cell)
        columns[threshold_label(key), "ours"] = table[f"score_{key}"].map(_cell)
        columns[threshold_label(key), "95 %"] = interval.where(low < high, "")
        columns[threshold_label(key), DIVIDED] = table[f"released_{key}"].map(_cell)
        columns[threshold_label(key), "paper"] = table[f"paper_{key}"].map(_cell)
    cells = pd.DataFrame(columns)
    cells.index = pd.MultiIndex.from_frame(table[["paper_row", "method"]], names=["paper", "here"])
    return cells


def paper_styler(table: pd.DataFrame) -> Styler:
    """Style `paper_cells` for a notebook: best numbers in bold, intervals and "/0.527" in grey."""
    cells = paper_cells(table)
    bold = pd.DataFrame("", index=cells.index, columns=cells.columns)
    for key in KEYS:
        for source, name in ((f"score_{key}", "ours"), (f"paper_{key}", "paper")):
            values = table[source].to_numpy()
            bold.loc[values == table[source].max(), (threshold_label(key), name)] = "font-weight: bold"
        bold[threshold_label(key), "95 %"] = bold[threshold_label(key), DIVIDED] = "color: #777777; font-size: 85%"
    layout: list[Any] = [
        {"selector": "td", "props": "text-align: right; white-space: nowrap; padding: 2px 6px"},
        {"selector": "th", "props": "text-align: left; white-space: nowrap; font-weight: normal; padding: 2px 6px"},
        {"selector": "th.col_heading", "props": "text-align: center; font-weight: bold"},
    ]
    return cells.style.apply(lambda _: bold, axis=None).set_table_styles(layout)


def _cell(value: float) -> str:
    return "–" if pd.isna(value) else f"{value:.1f}"
