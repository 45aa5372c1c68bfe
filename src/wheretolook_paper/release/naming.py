"""What a release is called: it is a dataset of its own, beside the one that it is a copy of."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from wheretolook.dataset.names import RELEASE_FILE
from wheretolook.utils.errors import ConfigError


class Names(Protocol):
    """What settings say of names: the folder of all datasets, the dataset's own, and what its release is called."""

    @property
    def data(self) -> Path: ...
    @property
    def root(self) -> Path: ...
    @property
    def release_name(self) -> str: ...


def check(names: Names) -> None:
    """Raise ConfigError if the copy would replace its dataset. A release that is finished, not copied, is itself."""
    root = names.data / names.release_name
    if root.resolve() == names.root.resolve() and not (root / RELEASE_FILE).is_file():
        fix = "Give --release_name another name: the copy is a dataset of its own, beside this one."
        problem = "the release has the name of the dataset that it is a copy of"
        raise ConfigError(problem, path=root, value=names.release_name, fix=fix)
