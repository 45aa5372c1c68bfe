"""Names that become paths, from files and options: they stay within the folder that they are names in."""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath

from wheretolook.utils.errors import ConfigError


def check_folder_name(whose: str, name: str, taken: tuple[str, ...] = ()) -> None:
    """Raise ConfigError unless a name can be a new folder's and is not one of those taken."""
    if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9._-]*", name) or name in taken:
        others = f", but not {', '.join(taken)}" if taken else ""
        fix = f"Give it a name of letters, digits, '.', '_' and '-'{others}."
        raise ConfigError(f"{whose} becomes a folder's", value=name, fix=fix)


def entry_of(folder: Path, name: object, whose: str) -> Path:
    """The entry of a name in a folder, there already or not.

    Raises ConfigError if the name is none of an entry, such as "../x", "a/b" or "/x", or a link that leads out of the
    folder lies there.
    """
    if not isinstance(name, str) or name in ("", ".", "..") or "/" in name or "\0" in name:
        fix = "Give it the name of a folder or file, without '/'."
        raise ConfigError(f"{whose} would lead out of its folder", value=name, fix=fix)
    path = folder / name
    _check_link(path, folder.resolve())
    return path


def path_within(folder: Path, name: str, whose: str) -> Path:
    """The path of a name that may have folders in it, such as "left/1.jpg", for reading: links are followed.

    Raises ConfigError if it is absolute, or goes up.
    """
    parts = PurePosixPath(name)
    if parts.is_absolute() or ".." in parts.parts or not parts.parts or "\0" in name:
        raise ConfigError(f"{whose} would lead out of its folder", path=folder, value=name, fix="Give it another name.")
    return folder / name


def check_links(folder: Path, depth: int) -> None:
    """Raise ConfigError if a link in a folder, or in folders in it down to some depth, leads out of the folder.

    What is written where such a link lies would be written elsewhere. The folder itself may be one.
    """
    root = folder.resolve()
    pending = [(folder, depth)]
    while pending:
        within, left = pending.pop()
        with os.scandir(within) as entries:
            for entry in entries:
                if entry.is_symlink():
                    _check_link(Path(entry.path), root)
                elif left > 1 and entry.is_dir(follow_symlinks=False):
                    pending.append((Path(entry.path), left - 1))


def _check_link(path: Path, root: Path) -> None:
    if not path.is_symlink():
        return
    try:
        target = path.resolve()
    except (OSError, RuntimeError):  # a link to itself
        target = None
    if target is None or not target.is_relative_to(root):
        fix = "Remove the link, and put there what it leads to."
        raise ConfigError("this link leads out of its folder", path=path, value=os.readlink(path), fix=fix)
