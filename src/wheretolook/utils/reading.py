"""Reading of small text files with limits: what is read may be damaged, or made to do harm.

A file must be a regular one, of bounded size, and what it holds must be of bounded depth and size once it is read.
Whatever is wrong with it raises one kind of error, ValueError, which callers give the file's path and a fix; only a
file that is missing or cannot be opened raises OSError.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Any

MAX_TEXT_BYTES = 16_000_000  # of a JSON file: a hundred thousand photographs or shards
MAX_JSON_VALUES = 1_500_000  # an empty list takes three bytes of a file and eighty of memory
MAX_YAML_BYTES = 100_000  # of a file of settings; those that ship have a thousand
MAX_YAML_DEPTH = 50
MAX_YAML_LENGTH = 1_000_000  # characters once all aliases are written out


def check_file(path: Path) -> os.stat_result:
    """What is known of a regular file. ValueError if it is a folder, device or pipe; OSError if it is missing."""
    found = os.stat(path)
    if not stat.S_ISREG(found.st_mode):
        raise ValueError("this is no file" if stat.S_ISDIR(found.st_mode) else "this is a device, no file")
    return found


def read_text(path: Path, at_most: int = MAX_TEXT_BYTES) -> str:
    """A text in UTF-8. ValueError if it is none, no regular file, or has more bytes than `at_most`."""
    check_file(path)
    with path.open("rb") as file:
        content = file.read(at_most + 1)
    if len(content) > at_most:
        raise ValueError(f"it has more than {at_most:,} bytes")
    return content.decode("utf-8").replace("\r\n", "\n")


def parse_json(text: str) -> Any:
    """The value of a JSON text. ValueError if it is none, has too many values, or nests them too deeply."""
    if sum(map(text.count, ",[{")) > MAX_JSON_VALUES:
        raise ValueError(f"it has more than {MAX_JSON_VALUES:,} values")
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("its values are nested too deeply") from error


def parse_json_object(text: str) -> dict[str, Any]:
    """The object of a JSON text; see `parse_json`. ValueError if it is another value, too."""
    content = parse_json(text)
    if not isinstance(content, dict):
        raise ValueError(f"a JSON object is expected, not {str(content)[:40]!r}")
    return content


def read_json(path: Path) -> Any:
    """The value of a JSON file; see `read_text` and `parse_json`."""
    return parse_json(read_text(path))


def read_json_object(path: Path) -> dict[str, Any]:
    """The object of a JSON file; see `read_text` and `parse_json_object`."""
    return parse_json_object(read_text(path))


def read_yaml(path: Path) -> Any:
    """The value of a YAML file of plain values; ValueError if it is none, or its aliases write out to too much.

    Nothing else can come of it: both safe loaders are SafeConstructors, which make no objects of classes that a file
    names. CSafeLoader is no subclass of SafeLoader but does the same in compiled code, where PyYAML was built with it.
    """
    import yaml

    text = read_text(path, MAX_YAML_BYTES)
    safe_loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        _check_yaml_size(yaml.parse(text, Loader=safe_loader))
        return yaml.load(text, Loader=safe_loader)
    except (yaml.YAMLError, RecursionError, TypeError, OverflowError) as error:
        raise ValueError(" ".join(str(error).split())) from error


def _check_yaml_size(events: Iterable[Any]) -> None:
    """Raise ValueError if the values of a YAML file nest too deeply or, with aliases written out, are too long."""
    import yaml

    lengths: dict[str, int] = {}  # by anchor, of values that have ended
    open_values: list[tuple[str | None, int]] = []  # anchor, and the length of all that came before the value
    length = 0
    for event in events:
        before = length
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in lengths:
                raise ValueError(f"the alias *{event.anchor} is of no value before it")
            length += lengths[event.anchor]
        elif isinstance(event, yaml.ScalarEvent):
            length += 1 + len(event.value)
            if event.anchor:
                lengths[event.anchor] = length - before
        elif isinstance(event, yaml.CollectionStartEvent):
            length += 1
            open_values.append((event.anchor, before))
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_values.pop()
            if anchor:
                lengths[anchor] = length - before
        if len(open_values) > MAX_YAML_DEPTH:
            raise ValueError("its values are nested too deeply")
        if length > MAX_YAML_LENGTH:
            raise ValueError(f"with its aliases written out, it has more than {MAX_YAML_LENGTH:,} characters")
