"""Photographs of a scene's map, left out of it in blocks, for stages that learn from them or evaluate by them."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.config import Experiment
from wheretolook.dataset.layout import SceneFolder
from wheretolook.stages.preconditions import Say
from wheretolook.utils.errors import MapError
from wheretolook.utils.locks import hold

if TYPE_CHECKING:
    from wheretolook.holdout.holdout import HoldoutResult
    from wheretolook.holdout.photo_map import PhotographedMap


def knows_photographs(files: SceneFolder, images: Path | None = None, database: Path | None = None) -> bool:
    """Whether the features of the photographs that a scene's map was made from are known, or these themselves."""
    from wheretolook.mapping.colmap_model import holds_model
    from wheretolook.mapping.sources import features_beside, photographs_of

    if not holds_model(files.map):
        return False
    given = images or database or features_beside(files.map) or photographs_of(files.map)
    return given is not None


def check_name(experiment: Experiment, files: SceneFolder) -> str:
    """What the folder of a scene's check is called: as by `check --name`, unless there is one as by `check` alone."""
    from wheretolook.holdout.photo_map import CHECKS

    names = f"{experiment.name}-{files.name}", files.name
    return next((name for name in names if (experiment.data / CHECKS / name).is_dir()), names[0])


def leave_photographs_out(
    experiment: Experiment,
    stage: str,
    model: Path,
    name: str,
    metric: bool,
    keep_frame: bool,
    images: Path | None,
    database: Path | None,
    say: Say,
    upright: bool = False,
) -> tuple[PhotographedMap, list[HoldoutResult]]:
    """A map, and its photographs left out in blocks, in the folder of its check: neither does again what the other did.

    See `wheretolook.holdout.photo_map.open_map` for what is asked and raised; with `upright`, a MapError is raised if the
    model's cameras seem to lie on their side.
    """
    from wheretolook.holdout.holdout import left_out_blocks
    from wheretolook.holdout.photo_map import WORK, features_of, folder_of_check, open_map

    out = folder_of_check(experiment.data, name)
    workers = experiment.n_workers
    device = experiment.warp_device
    try:
        with hold(out / ".lock", stage):
            folder, features = features_of(model, images, database, out / WORK, workers, device)
            source = open_map(folder, features, metric, name, keep_frame=keep_frame)
            if upright and source.is_turned:
                fix = "Make a scene of it: `wheretolook map --name NAME --model SPARSE --map.existing.level true`."
                raise MapError("the map lies on its side, and this needs z up", path=model, fix=fix)
            say(f"{name}: leaving out blocks of {len(source.poses)} photographs")
            return source, left_out_blocks(source, out / WORK, workers=workers, device=device)
    finally:
        with suppress(OSError):  # made for the lock of a stage that then found nothing to work on
            out.rmdir()
