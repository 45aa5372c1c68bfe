"""Log times of the visibility check, measured by `tests/benchmarks/bench_visibility.py`, as an MLflow run."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from wheretolook.figures.floor_plan import save_figure
from wheretolook.tracking import Tags, TrackingConfig, log, start_run
from wheretolook.utils.files import copy_file, temporary_folder
from wheretolook_paper.figures.runtimes import runtime_figure, scaling_figure

RUNTIMES_CSV = "runtimes.csv"
SCALING_CSV = "scaling.csv"
"""Tables of `figures.runtimes`: times at the paper's size, and growth of time and memory."""


def log_runtimes(tracking: TrackingConfig, results: Path, tags: Tags = None) -> str:
    """Log the measured times in a folder as a run of the stage "benchmark" with their figures; return its id.

    `RUNTIMES_CSV` is the table of `runtime_figure`, `SCALING_CSV`, which may be missing, that of `scaling_figure`.
    """
    sizes = pd.read_csv(results / RUNTIMES_CSV)
    scaling = results / SCALING_CSV
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
        copy_file(results / RUNTIMES_CSV, folder / RUNTIMES_CSV)
        save_figure(runtime_figure(sizes), folder / "runtimes.png")
        if scaling.is_file():
            copy_file(scaling, folder / SCALING_CSV)
            save_figure(scaling_figure(pd.read_csv(scaling)), folder / "visibility-scaling.png")
        client.log_artifacts(run, str(folder))
    return run
