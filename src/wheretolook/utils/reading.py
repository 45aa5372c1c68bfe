"""Reads JSON, YAML and text files with limits on their size and depth: files may be damaged or crafted.

Whatever is wrong with a file's content raises ValueError, to which callers add the path and a fix; only a file that is
missing or cannot be opened raises OSError.
"""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path
from typing import Any

MAX_TEXT_BYTES = 16_000_000  # of a JSON file: a hundred thousand photographs or shards
MAX_JSON_VALUES = 1_500_000  # an empty list takes three bytes of a file and eighty of memory
MAX_YAML_BYTES = 100_000
MAX_YAML_DEPTH = 50  # PyYAML's compiled loader overflows the stack at some ten thousand
MAX_YAML_SIZE = 1_000_000  # values and characters, with aliases written out
MAX_RATIO = 100  # of expanded to stored bytes of arrays and tables; occlusion of the bundled maps has 8, a bomb 1032
FREE_BYTES = 128_000_000  # that any file of arrays may expand to


def check_file(path: Path, pipes: bool = False) -> os.stat_result:
    """Return the status of a regular file or, if `pipes`, of one that the shell opened, such as /dev/stdin.

    Raises ValueError for a folder, device or other pipe, OSError if it is missing.
    """
    status = os.stat(path)
    is_open_pipe = pipes and stat.S_ISFIFO(status.st_mode) and str(path).startswith("/dev/")
    if not stat.S_ISREG(status.st_mode) and not is_open_pipe:
        raise ValueError("this is no regular file")
    return status


def max_expanded_bytes(n_bytes: int) -> int:
    """Return how many bytes a file of arrays or a table of `n_bytes` may expand to in memory."""
    return max(FREE_BYTES, MAX_RATIO * n_bytes)


def read_text(path: Path, at_most: int = MAX_TEXT_BYTES, pipes: bool = False) -> str:
    """Read a UTF-8 text, without a byte-order mark (see `check_file`). Raises ValueError if it is none, no regular file, or has more bytes than `at_most`."""
    check_file(path, pipes)
    with path.open("rb") as file:
        content = file.read(at_most + 1)
    if len(content) > at_most:
        raise ValueError(f"it has more than {at_most:,} bytes")
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise ValueError("it is no text in UTF-8") from error


def parse_json(text: str) -> Any:
    """Parse a JSON text. Raises ValueError if it is none, has too many values, or nests them too deeply."""
    if sum(map(text.count, ",[{")) > MAX_JSON_VALUES:
        raise ValueError(f"it has more than {MAX_JSON_VALUES:,} values")
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("its values are nested too deeply") from error


def parse_json_object(text: str) -> dict[str, Any]:
    """Parse a JSON text that is an object (see `parse_json`)."""
    content = parse_json(text)
    if not isinstance(content, dict):
        raise ValueError(f"a JSON object is expected, not {str(content)[:40]!r}")
    return content


def read_json(path: Path) -> Any:
    """Read a JSON file (see `read_text` and `parse_json`)."""
    return parse_json(read_text(path))


def read_json_object(path: Path) -> dict[str, Any]:
    """Read a JSON file that is an object (see `read_text` and `parse_json`)."""
    return parse_json_object(read_text(path))


def read_yaml(path: Path) -> Any:
    """Read a YAML file of plain values with a safe loader, which creates no objects of classes that a file names.

    Raises ValueError if it is none, if a key is given twice, or if its aliases expand to too much.
    """
    import yaml

    text = read_text(path, MAX_YAML_BYTES)
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    depth = 0
    try:
        for event in yaml.parse(text, Loader=loader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > MAX_YAML_DEPTH:
                raise ValueError("its values are nested too deeply")
        _check_keys(yaml.compose(text, Loader=loader))
        content = yaml.load(text, Loader=loader)
    except (yaml.YAMLError, RecursionError, TypeError, OverflowError) as error:
        raise ValueError(" ".join(str(error).split())) from error
    _check_expanded_size(content)
    return content


def _check_keys(root: Any) -> None:
    """Raise ValueError if a mapping in a tree of YAML nodes has a key twice: the first value would be ignored."""
    pending = [root]
    known: set[int] = set()  # nodes may be shared by aliases
    while pending:
        node = pending.pop()
        if isinstance(node, tuple):
            pending += node
        elif isinstance(getattr(node, "value", None), list) and id(node) not in known:
            known.add(id(node))
            pending += node.value
            keys = [key.value for key, _ in node.value if isinstance(key.value, str)] if node.id == "mapping" else []
            for key in keys:
                if keys.count(key) > 1 and key != "<<":
                    raise ValueError(f"the key {key} is given twice")


def _check_expanded_size(content: Any) -> None:
    """Raise ValueError if a nested value, each reference to a shared part counted, is larger than `MAX_YAML_SIZE`."""
    pending = [content]
    size = 0
    while pending:
        value = pending.pop()
        size += 1
        if isinstance(value, dict):
            pending += [*value, *value.values()]
        elif isinstance(value, list):
            pending += value
        elif isinstance(value, str):
            size += len(value)
        if size + len(pending) > MAX_YAML_SIZE:
            raise ValueError(f"with its aliases written out, it is larger than {MAX_YAML_SIZE:,}")
