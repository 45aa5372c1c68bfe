"""Photographs of a scene's map held out of it in blocks, to train on or to evaluate."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.commands.options import LabelOptions, Log
from wheretolook.dataset.layout import SceneFolder
from wheretolook.utils.errors import MapError
from wheretolook.utils.locks import hold

if TYPE_CHECKING:
    from wheretolook.holdout.holdout import HoldoutResult
    from wheretolook.holdout.photo_map import PhotographedMap


def knows_photographs(files: SceneFolder, images: Path | None = None, database: Path | None = None) -> bool:
    """Return whether the photographs that a scene's map was made from, or their features, are known."""
    from wheretolook.mapping.colmap_model import holds_model
    from wheretolook.mapping.sources import find_features, find_photographs

    if not holds_model(files.map):
        return False
    given = images or database or find_features(files.map) or find_photographs(files.map)
    return given is not None


def check_name(options: LabelOptions, files: SceneFolder) -> str:
    """Return the folder name of a scene's check: that of `check --name`, unless only that of `check` exists."""
    from wheretolook.holdout.photo_map import CHECKS

    names = f"{options.name}-{files.name}", files.name
    return next((name for name in names if (options.data / CHECKS / name).is_dir()), names[0])


def hold_out_photographs(
    options: LabelOptions,
    stage: str,
    model: Path,
    name: str,
    metric: bool,
    keep_frame: bool,
    images: Path | None,
    database: Path | None,
    log: Log,
    upright: bool = False,
) -> tuple[PhotographedMap, list[HoldoutResult]]:
    """Return a map and its photographs, held out in blocks; finished blocks are shared with `wheretolook check`.

    See `wheretolook.holdout.photo_map.open_map` for arguments and errors; `upright` raises MapError if the model's
    cameras seem to be on their side.
    """
    from wheretolook.holdout.holdout import hold_out_blocks
    from wheretolook.holdout.photo_map import WORK, features_of, folder_of_check, open_map

    out = folder_of_check(options.data, name)
    workers = options.n_workers
    device = options.warp_device
    try:
        with hold(out / ".lock", stage):
            folder, features = features_of(model, images, database, out / WORK, workers, device)
            source = open_map(folder, features, metric, name, keep_frame=keep_frame)
            if upright and source.is_turned:
                fix = "Make a scene of it: `wheretolook map --name NAME --model SPARSE --map.existing.level true`."
                raise MapError("the map lies on its side, and this needs z up", path=model, fix=fix)
            log(f"{name}: leaving out blocks of {len(source.poses)} photographs")
            return source, hold_out_blocks(source, out / WORK, workers=workers, device=device)
    finally:
        with suppress(OSError):  # created for the lock only
            out.rmdir()
