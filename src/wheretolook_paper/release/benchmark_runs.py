"""Log times of the visibility check, measured by `tests/benchmarks/bench_visibility.py`, as an MLflow run."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from wheretolook.figures.style import save_figure
from wheretolook.tracking.config import TrackingConfig
from wheretolook.tracking.runs import Tags, log, start_run
from wheretolook.utils.files import copy_file, temporary_folder
from wheretolook_paper.figures.runtimes import runtime_figure, scaling_figure

RUNTIMES_CSV = "runtimes.csv"
SCALING_CSV = "scaling.csv"
"""Tables of `figures.runtimes`: times at the paper's size, and growth of time and memory."""


def log_runtimes(
    tracking: TrackingConfig, sizes: pd.DataFrame, growth: pd.DataFrame, tags: Tags = None, file: Path | None = None
) -> str:
    """Log measured times as a run of the stage "benchmark" with both tables and their figures; return its id.

    `sizes` is the table of `runtime_figure`, `growth` that of `scaling_figure` (may be empty). The file from which
    `sizes` were read, if given, is logged unchanged.
    """
    metrics = {}
    for row in sizes.dropna(subset="median_s").to_dict("records"):
        name = f"{row['what']} {row['device'].split(':')[0]} {row['threads']} threads s"
        metrics["".join(letter for letter in name if letter.isalnum() or letter == " ")] = float(row["median_s"])
    machines = " + ".join(dict.fromkeys(map(str, sizes["name"])))
    with (
        temporary_folder() as folder,
        start_run(tracking, "visibility check", "benchmark", {"machines": machines}, tags=tags) as (client, run),
    ):
        log(client, run, metrics=metrics)
        if file is None:
            sizes.to_csv(folder / RUNTIMES_CSV, index=False)
        else:
            copy_file(file, folder / RUNTIMES_CSV)
        save_figure(runtime_figure(sizes), folder / "runtimes.png")
        if len(growth):
            growth.to_csv(folder / SCALING_CSV, index=False)
            save_figure(scaling_figure(growth), folder / "visibility-scaling.png")
        client.log_artifacts(run, str(folder))
    return run
