"""What a release is called: it is a dataset of its own, beside the one that it is a copy of."""

from __future__ import annotations

from typing import TYPE_CHECKING

from wheretolook.dataset.names import RELEASE_FILE
from wheretolook.utils.errors import ConfigError

if TYPE_CHECKING:
    from wheretolook.config import Experiment


def check(experiment: Experiment) -> None:
    """Raise ConfigError if the copy would replace its dataset. A release that is finished, not copied, is itself."""
    root = experiment.data / experiment.release_name
    if root.resolve() == experiment.root.resolve() and not (root / RELEASE_FILE).is_file():
        fix = "Give --release_name another name: the copy is a dataset of its own, beside this one."
        problem = "the release has the name of the dataset that it is a copy of"
        raise ConfigError(problem, path=root, value=experiment.release_name, fix=fix)
