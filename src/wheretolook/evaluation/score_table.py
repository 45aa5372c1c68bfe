"""What a table of localization scores is about: its thresholds, main rows, methods and reference."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from wheretolook.methods.names import Method


def threshold_keys(scores: pd.DataFrame) -> list[str]:
    """Thresholds of a score table, by the names its columns use."""
    return [name.removeprefix("normalized_") for name in scores.columns if name.startswith("normalized_")
            and not name.startswith(("normalized_low_", "normalized_high_"))]  # fmt: skip


def main_rows(scores: pd.DataFrame, columns: Sequence[str] = ("occlusion", "candidates")) -> pd.DataFrame:
    """Rows of a table's first occlusion model and first set of candidates; an older table may name neither."""
    for name in columns:
        if name in scores:
            scores = scores[scores[name] == scores[name].iloc[0]]
    return scores


def methods_of(scores: pd.DataFrame) -> list[Method]:
    """The methods of a score table with their inputs, in order."""
    return list(dict.fromkeys(zip(scores["method"], scores["inputs"], strict=True)))


def reference_of(scores: pd.DataFrame) -> Method | None:
    """The method that a score table compares the others with. None if there is none."""
    name = scores["reference"].iloc[0] if "reference" in scores else ""
    return next((method for method in methods_of(scores) if name and " ".join(method).strip() == name), None)
