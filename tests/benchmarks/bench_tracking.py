"""How long MLflow takes for nested runs, for the runs of a release, and for those of one evaluation.

    python tests/benchmarks/bench_tracking.py                        # 500 runs of 30 metrics; data/release
    python tests/benchmarks/bench_tracking.py --runs 60 --metrics 360

All by MLflow's public client, on a new store each (SQLite). The first tells what a run for each method, inputs, N,
occlusion model and candidate set would take; an evaluation logs one for all N (`wheretolook.evaluation.results`). The
evaluation here has the release's scores and as many locations, made up. Seconds of the processor are told beside the
seconds passed, which a busy machine or a slow disk lengthens. Nothing here fails on time.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pandas as pd

from wheretolook.dataset.layout import Dataset
from wheretolook.evaluation.results import SCORES_CSV, runs_of_rows
from wheretolook.evaluation.scores import read_scores
from wheretolook.utils.tracking import NestedRun, client, log_nested, start_run
from wheretolook.utils.tracking_config import TrackingConfig
from wheretolook_paper.release.runs import log_release


@contextmanager
def timed(what: str) -> Iterator[None]:
    start = time.perf_counter()
    processor = time.process_time()
    yield
    print(f"{what:60} {time.perf_counter() - start:6.1f} s, {time.process_time() - processor:6.1f} s of the processor")


def new_store() -> TrackingConfig:
    return TrackingConfig(tempfile.mkdtemp(prefix="tracking-"))


def with_locations(table: pd.DataFrame, n_locations: int, folder: Path) -> Iterator[NestedRun]:
    """An evaluation's nested runs, each with a table of as many locations."""
    file = folder / "locations.parquet"
    columns = {
        f"{name}_{number}": np.random.default_rng(0).random(3 * n_locations) for name in "gab" for number in "123"
    }
    for nested in runs_of_rows(table, {"dataset": "made up", "scenes": "a b"}):
        pd.DataFrame(columns).to_parquet(file, index=False)
        yield NestedRun(nested.name, nested.params, nested.metrics, (file,))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--metrics", type=int, default=30)
    parser.add_argument("--release", type=Path, default=Path("data/release"))
    args = parser.parse_args()
    with timed("a new store, with MLflow's import"):
        client(new_store()).search_experiments()

    tracking = new_store()
    client(tracking).search_experiments()
    metrics = {f"metric {number}": float(number) for number in range(args.metrics)}
    with (
        start_run(tracking, "parent", "evaluate") as (_, parent),
        timed(f"{args.runs} nested runs of {args.metrics} metrics"),
    ):
        params = {f"parameter {number}": "x" for number in range(15)}
        log_nested(tracking, parent, "evaluate", [NestedRun("nested", params, metrics)] * args.runs)

    release = Dataset.load(args.release)
    table = read_scores(release.root / "results" / SCORES_CSV)
    tracking = new_store()
    client(tracking).search_experiments()
    with (
        tempfile.TemporaryDirectory() as folder,
        start_run(tracking, "parent", "evaluate") as (_, parent),
        timed("one evaluation of the release's size"),
    ):
        n_locations = int(table["n_locations"].max())
        log_nested(tracking, parent, "evaluate", with_locations(table, n_locations, Path(folder)))

    tracking = new_store()
    client(tracking).search_experiments()
    with timed("log-release"):
        log_release(release, tracking)
    with timed("log-release again"):
        log_release(release, tracking)


if __name__ == "__main__":
    main()
