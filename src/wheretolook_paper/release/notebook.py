"""Find the release and the tracking store from any folder inside a checkout, for notebooks."""

from __future__ import annotations

import os
from pathlib import Path

from wheretolook.dataset.config import RELEASE
from wheretolook.dataset.layout import Dataset
from wheretolook.tracking import TrackingConfig
from wheretolook.utils.errors import ConfigError

RELEASE_VARIABLE = "WHERETOLOOK_RELEASE"
STORE_VARIABLE = "WHERETOLOOK_MLRUNS"
"""Environment variables with the folders of a release and of a store."""


def open_release() -> Dataset:
    """Open the release in `WHERETOLOOK_RELEASE`, or the nearest `data/release` here or above.

    Raises ConfigError if there is none, TableError if it is damaged.
    """
    here = Path.cwd()
    named = os.environ.get(RELEASE_VARIABLE)
    places = [Path(named)] if named else [folder / "data" / RELEASE for folder in (here, *here.parents)]
    for place in places:
        if (place / "dataset.json").is_file():
            return Dataset.load(place)
    fix = f"Open the notebook inside a checkout, or name its folder in {RELEASE_VARIABLE}."
    raise ConfigError("there is no release here or in a folder above", path=places[0], fix=fix)


def find_store() -> TrackingConfig:
    """Return the store in `WHERETOLOOK_MLRUNS`, or the nearest folder `mlruns` here or above, even if empty."""
    here = Path.cwd()
    named = os.environ.get(STORE_VARIABLE)
    folders = [folder / "mlruns" for folder in (here, *here.parents)]
    nearest = next((folder for folder in folders if folder.is_dir()), folders[0])
    return TrackingConfig(named or str(nearest))


def open_store(release: Dataset | None = None) -> TrackingConfig:
    """Return the store of `find_store`, after logging missing runs of a release (`open_release` by default).

    Raises ConfigError if there is no release, TableError if it is damaged.
    """
    from wheretolook_paper.release.runs import log_release

    tracking = find_store()
    log_release(open_release() if release is None else release, tracking, print)
    return tracking
