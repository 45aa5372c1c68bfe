"""The log-release stage: what a release ships, logged as MLflow runs."""

from __future__ import annotations

from pathlib import Path

from wheretolook.config import Experiment
from wheretolook.dataset.dataset_lock import reads_dataset
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.names import RELEASE_FILE
from wheretolook.figures.config import FiguresConfig
from wheretolook.stages.preconditions import Say
from wheretolook.tracking.runs import ui_command
from wheretolook.tracking.store import check_store
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import temporary_folder

_TABLES = ("table_vs_others", "table_input_variants")
QUICK = ("top_n", *_TABLES, "training", "calibration", "scores", "regret", "paths", "runtimes")
"""Figures and tables that need no scene, and so only seconds."""


@reads_dataset("log-release")
def log_release(experiment: Experiment, say: Say = print, attach: bool = True) -> Dataset:
    """Log what a release holds as MLflow runs, as far as the store lacks them, on request with figures and tables.

    Raises ConfigError if the dataset is no release, TableError if there is none.
    """
    dataset = Dataset.load(experiment.root)
    if not (dataset.root / RELEASE_FILE).is_file():
        fix = "Its runs are logged by the stages themselves; a release is made by `wheretolook release`."
        raise ConfigError("this dataset is no release", path=experiment.root, fix=fix)
    check_store(experiment.tracking)
    from wheretolook_paper.release.catalog import write_items  # these take seconds, and what can be refused has been
    from wheretolook_paper.release.runs import log_release as log_runs

    runs = log_runs(dataset, experiment.tracking, say)
    if runs.new and attach:
        say("attaching figures and tables")
        with temporary_folder() as folder:
            config = FiguresConfig(Path(folder), QUICK, ("png",))
            write_items(dataset, experiment.tracking, config, lambda text: None)
    say(f"{runs.new} runs are new; all runs: {ui_command(experiment.tracking)}")
    return dataset
