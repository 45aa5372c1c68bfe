"""What fills and reads the tracking store as a whole: the runs of a release, and every figure drawn from runs."""

from __future__ import annotations

from collections.abc import Callable

from wheretolook.config import Experiment
from wheretolook.dataset import Dataset
from wheretolook.errors import ConfigError, MissingRunError
from wheretolook.tracking import ui_command

Say = Callable[[str], None]


def log_release(experiment: Experiment, say: Say = print) -> Dataset:
    """Log what a release holds as MLflow runs, as far as the store lacks them.

    Raises:
        ConfigError: the dataset is no release. TableError: there is none.
    """
    from wheretolook.release import is_release
    from wheretolook.release_runs import log_release as log_runs

    dataset = Dataset.load(experiment.root)
    if not is_release(dataset):
        fix = "Its runs are logged by the stages themselves; a release is made by `wheretolook release`."
        raise ConfigError("this dataset is no release", path=experiment.root, fix=fix)
    runs = log_runs(dataset, experiment.tracking, say)
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
        log_release(experiment, say)
    missing = write_items(dataset, experiment.tracking, experiment.figures, say)
    wanted = experiment.figures.only or [item.name for item in ITEMS if item.paper]
    needed = {name: command for name, command in missing.items() if name in wanted}
    if needed:
        fix = "Run " + "; ".join(dict.fromkeys(needed.values()))
        raise MissingRunError("not all figures could be drawn", value=", ".join(needed), fix=fix)
    return dataset
