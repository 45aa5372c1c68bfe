"""Checks what a binary glTF file tells of itself against its size, before a parser believes it."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from PIL import Image

from wheretolook.utils.errors import SceneError

_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}  # glTF 2.0 specification, section 3.6.2.2
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_DEEPEST = 500  # nodes within nodes
_FIX = "Export the scene again"
_LISTS = ("buffers", "bufferViews", "accessors", "meshes", "nodes", "scenes", "materials", "textures", "images")


def check_glb(tree: Any, path: Path, n_bytes: int) -> None:
    """Raise SceneError if views or accessors exceed the file of so many bytes, or its parts do not fit together."""
    try:
        _check(tree, path, n_bytes)
    except (TypeError, KeyError, IndexError, AttributeError, ValueError) as error:
        value = f"{type(error).__name__}: {error}"
        raise SceneError("the glTF file is corrupt", path=path, value=value, fix=_FIX) from error


def check_image(data: bytes, index: int, path: Path) -> None:
    """Raise SceneError if PIL cannot open an image, which trimesh leaves out without an error."""
    try:
        Image.open(io.BytesIO(data)).close()
    except Exception as error:  # decoders raise errors of many kinds
        problem = f"texture {index} is damaged or too large"
        raise SceneError(problem, path=path, value=str(error)[:200], fix=_FIX) from error


def _check(tree: Any, path: Path, n_bytes: int) -> None:
    def refuse(problem: str, value: object) -> None:
        raise SceneError(f"the glTF file is corrupt: {problem}", path=path, value=value, fix=_FIX)

    if not isinstance(tree, dict):
        refuse("its JSON is no object", type(tree).__name__)
    for name in _LISTS:
        items = tree.get(name, [])
        if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
            refuse(f"{name} is no list of objects", str(items)[:80])
    views, accessors, nodes = (tree.get(name, []) for name in ("bufferViews", "accessors", "nodes"))
    for index, view in enumerate(views):
        begin, length = view.get("byteOffset", 0), view["byteLength"]
        embedded = "uri" in tree["buffers"][view["buffer"]]  # of a size that is not the file's to tell
        if not (_is_whole(begin) and _is_whole(length)) or (not embedded and begin + length > n_bytes):
            refuse(f"view {index} lies outside of the file", (begin, length))
    for index, accessor in enumerate(accessors):
        count, begin = accessor["count"], accessor.get("byteOffset", 0)
        if not _is_whole(count) or count == 0 or not _is_whole(begin):
            refuse(f"accessor {index} has no such number of elements", count)
        size = _COMPONENT_BYTES[accessor["componentType"]] * _COMPONENTS[accessor["type"]]
        room, stride = n_bytes, size
        if "bufferView" in accessor:
            view = views[_index(accessor["bufferView"], views)]
            room, stride = view["byteLength"], view.get("byteStride", size)
            if not _is_whole(stride) or stride < 1:
                refuse(f"accessor {index} has no such stride", stride)
        if begin + (count - 1) * stride + size > room:
            refuse(f"accessor {index} is larger than what holds it", count)
    for mesh in tree.get("meshes", []):
        for primitive in mesh["primitives"]:
            attributes = primitive["attributes"]
            counts = {key: accessors[_index(at, accessors)]["count"] for key, at in attributes.items()}
            if counts["POSITION"] != counts.get("TEXCOORD_0", counts["POSITION"]):
                refuse("there are not as many texture coordinates as vertices", counts["TEXCOORD_0"])
    parents: dict[int, int] = {}
    for parent, node in enumerate(nodes):
        for child in node.get("children", []):
            if parents.setdefault(_index(child, nodes), parent) != parent:
                refuse("a node has two parents", child)
    depth: dict[int, int] = {}
    for node in range(len(nodes)):
        chain = []
        at: int | None = node
        while at is not None and at not in depth:
            chain.append(at)
            if len(chain) > _DEEPEST:
                refuse(f"nodes are nested deeper than {_DEEPEST}", node)
            at = parents.get(at)
        base = 0 if at is None else depth[at]
        for step, one in enumerate(reversed(chain), 1):
            depth[one] = base + step
            if base + step > _DEEPEST:
                refuse(f"nodes are nested deeper than {_DEEPEST}", node)


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _index(value: Any, items: list[Any]) -> int:
    if not _is_whole(value) or value >= len(items):
        raise IndexError(value)
    return int(value)
