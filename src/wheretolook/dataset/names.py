"""Names of datasets and scenes, checked without opening a dataset."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

from wheretolook.utils.confine import safe_child
from wheretolook.utils.errors import ConfigError, TableError
from wheretolook.utils.reading import read_json_object

RELEASE = "release"  # name of the released dataset
RELEASE_FILE = "release.json"  # what a release was made from; the file that makes a dataset one
NO_DATASET = "Run the scenes stage first, or for a map of your own `wheretolook map --model SPARSE`."
LOCK = ".lock"  # in a dataset's folder: held by stages that change it, shared by those that read it


def check_scene_name(data: Path, name: str, dataset: str = "") -> None:
    """Check that a scene exists in a named dataset, or in any dataset of the folder `data`.

    Raises ConfigError if there is no such scene or a name leads out of its folder, TableError if the dataset is none.
    """
    if dataset:
        roots = [safe_child(data, dataset, "a dataset's name")]
        if not (roots[0] / "dataset.json").is_file():
            raise TableError("this folder is no dataset", path=roots[0] / "dataset.json", fix=NO_DATASET)
    else:
        roots = [path.parent for path in sorted(data.glob("*/dataset.json"))]
    if not any(safe_child(root, name, "a scene's name").is_dir() for root in roots):
        no_such_scene(roots[0] if dataset else data, name, roots)


def no_such_scene(path: Path, name: str, roots: Iterable[Path]) -> NoReturn:
    """Raise a ConfigError that lists the existing scenes."""
    scenes = [scene for root in roots for scene in scene_names(root)]
    fix = f"There are {', '.join(scenes)}." if scenes else "Make one with `wheretolook map --name NAME --model SPARSE`."
    raise ConfigError("there is no such scene", path=path, value=name, fix=fix)


def scene_names(root: Path) -> list[str]:
    """Names of a dataset's scenes; none if `dataset.json` is unreadable."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        return [str(entry["name"]) for entry in read_json_object(root / "dataset.json")["scenes"]]
    return []
