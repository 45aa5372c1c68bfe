"""What each stage of a scene was made from, `<scene>/stages.json`: by it a later run knows what it can reuse."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from wheretolook.dataset.layout import SceneFolder
from wheretolook.utils.errors import TableError
from wheretolook.utils.files import write_json
from wheretolook.utils.reading import read_json_object

STAGES = ("scenes", "map", "sample", "label")  # stages that work scene by scene, in order


def stage_key(stage: str, parts: list[Any]) -> str:
    """16 hexadecimal digits that change with what a stage works from."""
    text = json.dumps([stage, parts], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def read_stamp(scene: SceneFolder, stage: str) -> str | None:
    """The key a stage was finished with; None if it was not. TableError if `stages.json` is damaged."""
    return _read(scene).get(stage)


def write_stamp(scene: SceneFolder, stage: str, key: str) -> None:
    """Record a finished stage. The scene's later stages worked on what is now replaced: their stamps go."""
    write_json(_path(scene), {**_before(stage, _read(scene)), stage: key})


def forget_stamp(scene: SceneFolder, stage: str) -> None:
    """Take a stage's stamp away, and those of later ones."""
    stamps = _read(scene)
    if (kept := _before(stage, stamps)) != stamps:
        write_json(_path(scene), kept)


def is_done(scene: SceneFolder, stage: str, key: str, *results: Path) -> bool:
    """Whether a stage was finished with this key and its results are still there."""
    return read_stamp(scene, stage) == key and all(result.exists() for result in results)


def _before(stage: str, stamps: dict[str, str]) -> dict[str, str]:
    return {name: stamp for name, stamp in stamps.items() if name in STAGES[: STAGES.index(stage)]}


def _path(scene: SceneFolder) -> Path:
    return scene.folder / "stages.json"


def _read(scene: SceneFolder) -> dict[str, str]:
    path = _path(scene)
    try:
        stamps = read_json_object(path)
        if not all(isinstance(stamp, str) for stamp in stamps.values()):
            raise ValueError("a stage's key is a text")
        return stamps
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        fix = "Remove it, and run the scene's stages again."
        raise TableError(f"damaged record of finished stages: {error}", path=path, fix=fix) from error
