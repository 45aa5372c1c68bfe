"""Checks what a binary glTF file tells of itself against its size, before a parser believes it."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

from wheretolook.scenes.mesh_checks import check_image, check_texture_file
from wheretolook.utils.errors import SceneError

_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}  # glTF 2.0 specification, section 3.6.2.2
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_DEEPEST = 500  # nodes within nodes
_READABLE = ("image/png", "image/jpeg", "image/webp")
_FIX = "Export the scene again"
_LISTS = ("buffers", "bufferViews", "accessors", "meshes", "nodes", "scenes", "materials", "textures", "images")


def check_glb(tree: Any, path: Path, n_bytes: int) -> None:
    """Raise SceneError if views or accessors exceed the file of so many bytes, or its parts do not fit together."""
    try:
        _check(tree, path, n_bytes)
    except (TypeError, KeyError, IndexError, AttributeError, ValueError) as error:
        value = f"{type(error).__name__}: {error}"
        raise SceneError("the glTF file is corrupt", path=path, value=value, fix=_FIX) from error


def check_glb_images(tree: Any, path: Path, begin: int) -> list[int]:
    """The number of pixels of each image of a checked GLB file whose data begin at byte `begin`.

    Images lie in the file, as base64 in its JSON, or in files beside it. Raises SceneError if one cannot be read.
    """
    pixels = []
    for index, image in enumerate(tree.get("images", [])):
        name = f"texture {index}"
        uri = image.get("uri")
        if "bufferView" not in image and not isinstance(uri, str):
            raise SceneError(f"the glTF file is corrupt: {name} is nowhere", path=path, value=str(image)[:80], fix=_FIX)
        if "bufferView" not in image and not uri.startswith("data:"):
            pixels.append(check_texture_file(path.parent / uri, path))
            continue
        if "bufferView" not in image:
            pixels.append(check_image(io.BytesIO(_decoded(uri, name, path)), name, path))
            continue
        mime_type = image.get("mimeType", "")
        views = tree.get("bufferViews", [])
        if mime_type not in _READABLE:
            fix = "Use the GLB with JPEG or PNG textures; a .basis.glb holds compressed ones"
            raise SceneError("a texture is in a format that is not supported", path=path, value=mime_type, fix=fix)
        if not _is_whole(image["bufferView"]) or image["bufferView"] >= len(views):
            problem = "the glTF file is corrupt: an image has no such view"
            raise SceneError(problem, path=path, value=image["bufferView"], fix=_FIX)
        view = views[image["bufferView"]]
        data = _view_bytes(view, tree["buffers"][view["buffer"]].get("uri"), name, path, begin)
        pixels.append(check_image(io.BytesIO(data), name, path))
    return pixels


def _view_bytes(view: dict[str, Any], uri: str | None, name: str, path: Path, begin: int) -> bytes:
    """What a view holds of the file's own data, of a `data:` URI, or of a file beside it."""
    start = view.get("byteOffset", 0)
    length = view["byteLength"]
    if uri is not None and uri.startswith("data:"):
        return _decoded(uri, name, path)[start : start + length]
    with (path if uri is None else path.parent / uri).open("rb") as file:
        file.seek(start + (begin if uri is None else 0))
        return file.read(length)


def _decoded(uri: str, name: str, path: Path) -> bytes:
    """What a `data:` URI holds. SceneError if that is not base64."""
    kind, comma, content = uri.partition(",")
    try:
        if not comma or not kind.endswith(";base64"):
            raise ValueError(f"no base64 but {kind[:40]!r}")
        return base64.b64decode(content, validate=True)
    except ValueError as error:
        raise SceneError(f"{name} in a data: URI cannot be read", path=path, value=str(error), fix=_FIX) from error


def _bytes_of(buffer: dict[str, Any], path: Path, n_bytes: int) -> int:
    """How many bytes a buffer can hold at most: the file's own, of a `data:` URI, or of a file beside it."""
    uri = buffer.get("uri")
    if uri is None:
        return n_bytes
    if uri.startswith("data:"):
        return len(uri) * 3 // 4
    beside = path.parent / uri
    if not beside.is_file():
        raise SceneError("a file of the glTF scene is missing", path=path, value=str(beside), fix="Put it there")
    return beside.stat().st_size


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
        begin = view.get("byteOffset", 0)
        length = view["byteLength"]
        room = _bytes_of(tree["buffers"][_index(view["buffer"], tree["buffers"])], path, n_bytes)
        if not (_is_whole(begin) and _is_whole(length)) or begin + length > room:
            refuse(f"view {index} lies outside of the file", (begin, length))
    for index, accessor in enumerate(accessors):
        count = accessor["count"]
        begin = accessor.get("byteOffset", 0)
        if not _is_whole(count) or count == 0 or not _is_whole(begin):
            refuse(f"accessor {index} has no such number of elements", count)
        size = _COMPONENT_BYTES[accessor["componentType"]] * _COMPONENTS[accessor["type"]]
        room = n_bytes
        stride = size
        if "bufferView" in accessor:
            view = views[_index(accessor["bufferView"], views)]
            room = view["byteLength"]
            stride = view.get("byteStride", size)
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
