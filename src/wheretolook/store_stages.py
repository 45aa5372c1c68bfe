"""What fills and reads the tracking store as a whole: the runs of a release, and every figure drawn from runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from wheretolook.config import Experiment
from wheretolook.dataset import Dataset
from wheretolook.errors import ConfigError, MissingRunError
from wheretolook.figures.config import FiguresConfig
from wheretolook.tracking import ui_command

Say = Callable[[str], None]


QUICK = ("top_n", "table_vs_others", "table_input_variants", "training", "calibration", "scores", "regret", "paths",
         "runtimes")  # fmt: skip
"""Figures and tables that need no scene, and so only seconds."""


def log_release(experiment: Experiment, say: Say = print, attach: bool = True) -> Dataset:
    """Log what a release holds as MLflow runs, as far as the store lacks them.

    Args:
        experiment: names the release and the store.
        say: told what was logged.
        attach: whether to attach figures and tables to new runs.

    Raises:
        ConfigError: the dataset is no release. TableError: there is none.
    """
    from wheretolook.figures.catalog import write_items
    from wheretolook.release import is_release
    from wheretolook.release_runs import log_release as log_runs

    dataset = Dataset.load(experiment.root)
    if not is_release(dataset):
        fix = "Its runs are logged by the stages themselves; a release is made by `wheretolook release`."
        raise ConfigError("this dataset is no release", path=experiment.root, fix=fix)
    runs = log_runs(dataset, experiment.tracking, say)
    if runs.new and attach:
        say("attaching figures and tables")
        with TemporaryDirectory() as folder:
            config = FiguresConfig(Path(folder), QUICK, ("png",))
            write_items(dataset, experiment.tracking, config, lambda text: None)
    say(f"{runs.new} runs are new; all runs: {ui_command(experiment.tracking)}")
    return dataset


def figures(experiment: Experiment, say: Say = print) -> Dataset:
    """Draw every figure and table from logged runs; those of a release are logged first.

    Raises:
        MissingRunError: some of the paper's, or of those named, could not be made for want of a run; the others were.
        ConfigError: there is no figure of such a name. TableError: there is no dataset.
    """
    from wheretolook.figures.catalog import ITEMS, check_names, write_items
    from wheretolook.release import is_release

    check_names(experiment.figures)
    dataset = Dataset.load(experiment.root)
    if is_release(dataset):
        log_release(experiment, say, attach=False)
    missing = write_items(dataset, experiment.tracking, experiment.figures, say)
    wanted = experiment.figures.only or [item.name for item in ITEMS if item.paper]
    needed = {name: command for name, command in missing.items() if name in wanted}
    if needed:
        fix = "Run " + "; ".join(dict.fromkeys(needed.values()))
        raise MissingRunError("not all figures could be drawn", value=", ".join(needed), fix=fix)
    return dataset
