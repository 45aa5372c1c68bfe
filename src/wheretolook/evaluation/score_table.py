"""What a table of localization scores is about: its thresholds, main rows, methods and reference."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

PHOTOGRAPHS = "photographs"  # in the column `candidates`: of rows whose views are photographs left out of their maps


def threshold_keys(scores: pd.DataFrame) -> list[str]:
    """Thresholds of a score table, by the names its columns use."""
    ends = ("normalized_low_", "normalized_high_")
    shares = [name for name in scores.columns if name.startswith("normalized_") and not name.startswith(ends)]
    return [name.removeprefix("normalized_") for name in shares]


def main_rows(scores: pd.DataFrame, columns: Sequence[str] = ("occlusion", "candidates")) -> pd.DataFrame:
    """Rows of a table's first occlusion model and first set of candidates; an older table may name neither."""
    for name in columns:
        if name in scores:
            scores = scores[scores[name] == scores[name].iloc[0]]
    return scores


def methods_of(scores: pd.DataFrame) -> list[str]:
    """The methods of a score table, in order."""
    return list(scores["method"].unique())


def reference_of(scores: pd.DataFrame) -> str:
    """The method that a score table compares the others with; "" if there is none."""
    name = scores["reference"].iloc[0] if "reference" in scores else ""
    return str(name) if name in methods_of(scores) else ""
