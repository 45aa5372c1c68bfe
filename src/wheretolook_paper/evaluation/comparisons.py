"""Format further tables of scores as Markdown: by occlusion model, by set of candidates, and as the paper divides them."""

from __future__ import annotations

from functools import partial

import pandas as pd

from wheretolook.dataset.config import ALL, threshold_label
from wheretolook.evaluation.results import ORACLE, PHOTOGRAPHS, RELEASED_DIVISOR, main_rows, threshold_keys
from wheretolook_paper.evaluation.score_report import (
    Row,
    best_views,
    cross_table,
    method_table,
    number_text,
    score_text,
    share_text,
)
from wheretolook_paper.styles import method_group

_CANDIDATES = (
    "To choose from there are all labelled directions of a location, or those of them that are among its best K by the "
    "number of landmarks they see; the oracle chooses from the same. "
)


def comparisons_markdown(scores: pd.DataFrame) -> str:
    """Format the sections "By occlusion model", "By set of candidates" and "Divided by 0.527" of a score table."""
    if "candidates" in scores and not (scores["candidates"] == PHOTOGRAPHS).all():
        scores = scores[scores["candidates"] != PHOTOGRAPHS]
    parts = _comparison(scores, "occlusion", "occlusion model", "")
    parts += _comparison(scores, "candidates", "set of candidates", _CANDIDATES)
    parts += _released_table(scores)
    return "".join(f"{part}\n\n" for part in parts)


def _comparison(scores: pd.DataFrame, column: str, name: str, about: str) -> list[str]:
    """Format average precision and score of every method by the values of a column; empty if it has one value."""
    values = list(scores[column].unique()) if column in scores else []
    if len(values) < 2:
        return []
    key = threshold_keys(scores)[0]
    n = scores["top_n"].iloc[0]
    others = [other for other in ("occlusion", "candidates") if other != column]
    rows = main_rows(scores[(scores["scene"] == ALL) & (scores["top_n"] == n)], others)
    rows = rows[(rows["method"] != ORACLE) & (rows["method"].map(method_group) != "probes")]

    def cell(row: Row) -> str:
        return f"{number_text(row['average_precision'])}, {score_text(row, key, True)}"

    return [
        f"## By {name}: AP, and {best_views(n).lower()} of each location within {threshold_label(key)}",
        f"{about}The other tables are of the first, {values[0]}.",
        cross_table(rows, column, values, cell),
    ]


def _released_table(scores: pd.DataFrame) -> list[str]:
    main = main_rows(scores)
    keys = threshold_keys(scores)
    if f"released_{keys[0]}" not in main:
        return []
    n = main["top_n"].iloc[0]
    rows = main[(main["scene"] == ALL) & (main["top_n"] == n) & (main["method"].map(method_group) != "probes")]
    columns = [(threshold_label(key), f"released_{key}", partial(share_text, name="released", key=key)) for key in keys]
    return [
        f"## Divided by {RELEASED_DIVISOR}",
        f"{best_views(n)} of each location, for comparison with the paper's numbers only: its released code divides "
        f"the share in % by {RELEASED_DIVISOR} at all thresholds and on all scenes, so 100 is no limit.",
        method_table(rows, columns),
    ]
