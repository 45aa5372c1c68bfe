"""Photographs of a scene's map held out of it in blocks, to train on or to evaluate."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from wheretolook.commands.options import LabelOptions
from wheretolook.dataset.layout import SceneFolder
from wheretolook.mapping.config import FrameOptions
from wheretolook.utils.locks import hold

if TYPE_CHECKING:
    from wheretolook.holdout.holdout import HoldoutResult
    from wheretolook.holdout.photo_map import PhotographedMap


def knows_photographs(files: SceneFolder, images: Path | None = None, database: Path | None = None) -> bool:
    """Return whether the photographs that a scene's map was made from, or their features, are known."""
    from wheretolook.mapping.colmap_model import holds_model
    from wheretolook.mapping.mapped_images import find_features, find_photographs

    return holds_model(files.map) and any((images, database, find_features(files.map), find_photographs(files.map)))


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
    frame: FrameOptions = FrameOptions(),
    given: tuple[Path | None, Path | None] = (None, None),
) -> tuple[PhotographedMap, list[HoldoutResult]]:
    """Return a map and its photographs, held out in blocks; finished blocks are shared with `wheretolook check`.

    `given` are the folder of the photographs and the database, if they are not next to the map. See
    `wheretolook.holdout.photo_map.open_map` for the other arguments and errors.
    """
    from wheretolook.holdout.holdout import hold_out_blocks
    from wheretolook.holdout.photo_map import WORK, features_of, folder_of_check, open_map

    out = folder_of_check(options.data, name)
    workers = options.n_workers
    device = options.warp_device
    with hold(out / ".lock", stage):
        folder, features = features_of(model, *given, out / WORK, workers, device)
        source = open_map(folder, features, name, frame, model)
        return source, hold_out_blocks(source, out / WORK, workers=workers, device=device)
