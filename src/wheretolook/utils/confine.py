"""Turns names from files and options into paths within a folder."""

from __future__ import annotations

import re
import unicodedata
from pathlib import Path, PurePosixPath

from wheretolook.utils.errors import ConfigError


def check_folder_name(whose: str, name: str, reserved: tuple[str, ...] = ()) -> None:
    """Raise ConfigError unless a name can be a new folder's and is not reserved."""
    composed = unicodedata.normalize("NFC", name)  # of an accent and a letter, as macOS writes names
    if not re.fullmatch(r"[\w-]([\w. -]*[\w.-])?", composed) or name in reserved:
        others = f", but not {', '.join(reserved)}" if reserved else ""
        fix = f"Use letters, digits, spaces, '.', '_' and '-'{others}."
        raise ConfigError(f"{whose} becomes a folder's name", value=name, fix=fix)


def safe_child(folder: Path, name: object, whose: str) -> Path:
    """Return the path of a name in a folder. Raises ConfigError if it would leave the folder or is in a subfolder of it."""
    if not isinstance(name, str) or name in ("", ".", "..") or "/" in name or "\0" in name:
        raise ConfigError(f"{whose} must be the name of a folder or file, without '/'", value=name)
    return folder / name


def path_within(folder: Path, name: str, whose: str) -> Path:
    """Return the path of a name such as "left/1.jpg" in a folder. Raises ConfigError if it is absolute or goes up."""
    parts = PurePosixPath(name)
    if parts.is_absolute() or ".." in parts.parts or not parts.parts or "\0" in name:
        raise ConfigError(f"{whose} must be a path within its folder", path=folder, value=name)
    return folder / name
