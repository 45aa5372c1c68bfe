"""Train runs in the tracking store: parameters, metrics, and the history of every epoch."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from wheretolook.dataset.layout import Dataset
from wheretolook.tracking import TrackingConfig, artifact, finished_runs
from wheretolook.training.provenance import HISTORY_CSV, history_not_logged, params_of
from wheretolook.utils.errors import WeightsError
from wheretolook.utils.files import read_json_object, write_text

if TYPE_CHECKING:
    from mlflow.entities import Run

TRAINING_CSV = "training.csv"
"""In a release's `results/`: the histories of all trained methods, with a column `method`."""


def method_of_run(run: Run) -> str:
    """Return the method of a train run."""
    return str(run.data.params.get("method", ""))


def train_runs(
    tracking: TrackingConfig, dataset: str = "", method: str = "", file: str = ""
) -> Iterator[tuple[str, Run]]:
    """Yield methods and finished train runs, the newest first; "" stands for any."""
    for run in finished_runs(tracking, "train", params={"dataset": dataset} if dataset else None, file=file):
        name = method_of_run(run)
        if not method or name == method:
            yield name, run


def histories(tracking: TrackingConfig, dataset: str) -> dict[str, pd.DataFrame]:
    """Return the history of the newest run of each method trained on a dataset, by method."""
    oldest_first = reversed([*train_runs(tracking, dataset, file=HISTORY_CSV)])
    newest = {method: artifact(tracking, run.info.run_id, HISTORY_CSV) for method, run in oldest_first}
    return {method: pd.read_csv(path) for method, path in sorted(newest.items())}


def trained(tracking: TrackingConfig, dataset: str) -> pd.DataFrame:
    """Return the metrics of the newest run of each method trained on a dataset, the best first.

    Columns: `method`, `epoch` whose weights were kept, and on the validation views `average_precision`, `roc_auc` and
    `calibration_error`, NaN where the learner does not measure it.
    """
    found: dict[str, dict[str, Any]] = {}
    for method, run in train_runs(tracking, dataset):
        kept = run.data.metrics
        measures = {name: kept.get(f"kept_val_{name}", float("nan")) for name in _MEASURES}
        found.setdefault(method, {"method": method, "epoch": kept.get("kept_epoch", float("nan")), **measures})
    table = pd.DataFrame(list(found.values()), columns=["method", "epoch", *_MEASURES])
    table["epoch"] = table["epoch"].astype("Int64")
    return table.sort_values("average_precision", ascending=False, ignore_index=True)


_MEASURES = ("average_precision", "roc_auc", "calibration_error")


def records(folder: Path) -> dict[Path, dict[str, Any]]:
    """Read the records of training in a folder of weights and its subfolders; raise a WeightsError if damaged."""
    found = {}
    for path in sorted(folder.rglob("*.json")):
        try:
            found[path] = read_json_object(path)
            found[path]["about"]["method"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise WeightsError(f"not a record of training: {error}", path=path, fix="Train again.") from error
    return found


def read_histories(path: Path) -> pd.DataFrame:
    """Read `TRAINING_CSV`; empty without one."""
    return pd.read_csv(path) if path.is_file() else pd.DataFrame({"method": []})


def keep_histories(release: Dataset, tracking: TrackingConfig) -> pd.DataFrame:
    """Write `results/training.csv` of a release: the histories of its weights that the store has.

    A history is that of the run that trained the weights, or of the newest run with the same parameters. Methods
    without one keep their rows of the file.
    """
    path = release.root / "results" / TRAINING_CSV
    known = read_histories(path)
    kept = []
    for record in records(release.root / "weights").values():
        method = record["about"]["method"]
        same = {name: str(value) for name, value in params_of(record["about"]).items() if name != "method"}
        runs = (run for _, run in train_runs(tracking, same["dataset"], method, HISTORY_CSV))
        alike = [run for run in runs if same.items() <= run.data.params.items()]
        own = [run for run in alike if run.info.run_id == record["run_id"]]
        history = history_not_logged(record)
        if own or alike:
            history = pd.read_csv(artifact(tracking, (own or alike)[0].info.run_id, HISTORY_CSV))
        rows = known[known["method"] == method] if history is None else history.assign(method=method)
        kept.append(rows[["method", *rows.columns.drop("method")]])
    table = pd.concat([rows for rows in kept if len(rows)], ignore_index=True) if any(map(len, kept)) else known
    if len(table):
        write_text(path, table.to_csv(index=False, float_format="%.5g", lineterminator="\n"))
    return table
