"""Comparisons of methods: numbers with their intervals as text, MLflow runs, and tables that several runs fill."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from wheretolook.tracking import NestedRun, Tags, TrackingConfig, log, log_nested, start_run
from wheretolook.utils.files import write_text


def interval_text(row: Any, name: str, scale: float = 100.0, digits: int = 1) -> str:
    """Format a value and the ends of its interval, the columns `name`, `name_low` and `name_high` of a row."""
    value, low, high = (f"{scale * row[f'{name}{end}']:.{digits}f}" for end in ("", "_low", "_high"))
    return f"{value} [{low}, {high}]"


def log_comparison(
    tracking: TrackingConfig,
    name: str,
    stage: str,
    params: Mapping[str, Any],
    metrics: Mapping[str, float],
    nested: Iterable[NestedRun],
    files: Sequence[Path] = (),
    tags: Tags = None,
    about: Tags = None,
) -> str:
    """Log a comparison as a run with files and nested runs; return its id. `about` are tags of the run alone."""
    with start_run(tracking, name, stage, dict(params), tags={**(tags or {}), **(about or {})}) as (client, run):
        log(client, run, metrics=metrics, files=files)
        log_nested(tracking, run, stage, nested, tags)
    return run


def replace_rows(path: Path, rows: pd.DataFrame, keys: Sequence[str], float_format: str | None = None) -> pd.DataFrame:
    """Write rows to a CSV file in place of those with the same keys, sorted by the first key; return the new table."""
    others = pd.read_csv(path) if path.is_file() else rows[:0]
    names = list(keys)
    kept = others[~others.set_index(names).index.isin(rows.set_index(names).index)]
    table = pd.concat([kept, rows], ignore_index=True).sort_values(names[0], kind="stable", ignore_index=True)
    write_text(path, table.to_csv(index=False, float_format=float_format, lineterminator="\n"))
    return table
