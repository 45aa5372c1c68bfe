"""The figures stage: every figure and table, drawn from logged runs."""

from __future__ import annotations

from wheretolook.config import Experiment
from wheretolook.dataset.dataset_lock import reads_dataset
from wheretolook.dataset.layout import Dataset
from wheretolook.stages.preconditions import Say
from wheretolook.utils.errors import MissingRunError
from wheretolook_paper.commands.log_release import log_release


@reads_dataset("figures")
def figures(experiment: Experiment, say: Say = print) -> Dataset:
    """Draw every figure and table from logged runs; those of a release are logged first.

    Raises:
        MissingRunError: a figure of the paper, or one named in `figures.only`, has no run to be drawn from. All others
            were drawn.
        ConfigError: there is no figure of that name. TableError: there is no dataset.
    """
    dataset = Dataset.load(experiment.root)
    from wheretolook_paper.release.catalog import ITEMS, check_names, write_items  # takes seconds
    from wheretolook_paper.release.copy import is_release

    check_names(experiment.figures)
    if is_release(dataset):
        log_release(experiment, say, attach=False)
    missing = write_items(dataset, experiment.tracking, experiment.figures, say)
    wanted = experiment.figures.only or [item.name for item in ITEMS if item.paper]
    needed = {name: command for name, command in missing.items() if name in wanted}
    if needed:
        fix = "Run " + "; ".join(dict.fromkeys(needed.values()))
        raise MissingRunError("not all figures could be drawn", value=", ".join(needed), fix=fix)
    return dataset
