"""`wheretolook log-release`: what a release ships, logged as MLflow runs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from wheretolook.commands.options import DatasetOptions, Log
from wheretolook.dataset.config import RELEASE_FILE
from wheretolook.dataset.dataset_lock import reads_dataset
from wheretolook.tracking import TrackingConfig, check_store, ui_command
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import temporary_folder

if TYPE_CHECKING:
    from wheretolook.dataset.layout import Dataset

_TABLES = ("table_vs_others", "table_input_variants")
QUICK = ("top_n", *_TABLES, "training", "calibration", "scores", "regret", "paths", "runtimes")
"""Figures and tables that need no scene, and so only seconds."""


@dataclass(frozen=True, kw_only=True)
class LogRelease(DatasetOptions):
    """Log what a release ships as MLflow runs, as if it had been made here; once.

    A release ships its tables, not an MLflow store. This logs them into one, in seconds: an evaluation with its nested
    runs, a train run for each weights record, the comparison of learners, planned paths and measured times. Run again,
    it adds only what is new; `make ui` runs it first. Without --config it is configs/release.yaml.

    Examples:
      wheretolook log-release --tracking.folder elsewhere

    Args:
        tracking: where MLflow keeps its runs.
    """

    CONFIG: ClassVar = "release"

    tracking: TrackingConfig = field(default_factory=TrackingConfig)

    @reads_dataset("log-release")
    def run(self, log: Log = print) -> Dataset:
        """Log the release. Raises ConfigError if the dataset is no release, TableError if it does not exist."""
        from wheretolook.dataset.layout import Dataset

        dataset = Dataset.load(self.root)
        log_release(dataset, self.tracking, log)
        return dataset


def log_release(dataset: Dataset, tracking: TrackingConfig, log: Log = print, attach: bool = True) -> None:
    """Log what a release holds and the store lacks as MLflow runs; `attach` adds figures and tables.

    Raises ConfigError if the dataset is no release.
    """
    if not (dataset.root / RELEASE_FILE).is_file():
        fix = "Its runs are logged by the commands themselves; a release is made by `wheretolook release`."
        raise ConfigError("this dataset is no release", path=dataset.root, fix=fix)
    check_store(tracking)
    from wheretolook_paper.release.catalog import write_items  # these imports take seconds
    from wheretolook_paper.release.runs import log_release as log_runs

    runs = log_runs(dataset, tracking, log)
    if runs.new and attach:
        log("attaching figures and tables")
        with temporary_folder() as folder:
            write_items(dataset, tracking, Path(folder), QUICK, say=lambda text: None)
    log(f"{runs.new} runs are new; all runs: {ui_command(tracking)}")
