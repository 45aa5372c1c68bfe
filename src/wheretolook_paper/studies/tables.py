"""Tables of results that several runs fill."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from wheretolook.utils.files import write_text


def replace_rows(path: Path, rows: pd.DataFrame, keys: Sequence[str], float_format: str | None = None) -> pd.DataFrame:
    """Write rows to a CSV file in place of those with the same keys, sorted by the first key; return the new table."""
    others = pd.read_csv(path) if path.is_file() else rows[:0]
    names = list(keys)
    kept = others[~others.set_index(names).index.isin(rows.set_index(names).index)]
    table = pd.concat([kept, rows], ignore_index=True).sort_values(names[0], kind="stable", ignore_index=True)
    write_text(path, table.to_csv(index=False, float_format=float_format, lineterminator="\n"))
    return table
