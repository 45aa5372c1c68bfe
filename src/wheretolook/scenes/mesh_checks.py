"""Checks of GLB, PLY and OBJ files and their textures before trimesh reads them.

trimesh omits textures that it cannot read, or replaces them by a grey placeholder, without an error; it allocates
whatever accessors without data ask for, and takes the square of the number of parts of an OBJ file.
"""

from __future__ import annotations

import base64
import math
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from wheretolook.utils.devices import fitting
from wheretolook.utils.errors import SceneError
from wheretolook.utils.files import image_size, max_expanded_bytes, parse_json_object, read_text

MAX_PLY_HEADER = 1 << 16  # bytes
MAX_MTL_BYTES = 16_000_000
MAX_PARTS = 5000  # of an OBJ file
MAX_NODES = 20_000  # of a GLB file; trimesh takes 0.3 ms for each
MAX_DEPTH = 500  # of nodes within nodes
BYTES_PER_CORNER = 200  # of a triangle, while it is read
BYTES_PER_PIXEL = 11  # of a texture, while it is read
_LARGEST_ELEMENT = 64  # bytes of a 4 x 4 matrix


def check_mesh_file(path: Path) -> None:
    """Raise SceneError if counts in a mesh file exceed its size, or a texture is missing, unreadable or too large."""
    list_textures = {".glb": _glb_textures, ".ply": _ply_textures, ".obj": _obj_textures}[path.suffix.lower()]
    try:
        n_pixels = sum(math.prod(image_size(texture)) for texture in dict.fromkeys(list_textures(path)))
    except (ValueError, OSError, KeyError, IndexError, TypeError, AttributeError, struct.error) as error:
        problem = f"the file or a texture is truncated, corrupt or too large: {type(error).__name__}: {error}"
        raise SceneError(problem, path=path, fix="Copy or export the scene again.") from error
    limit = fitting(BYTES_PER_PIXEL)
    if n_pixels > limit:
        fix = f"Scale them down: {limit:,} pixels fit into memory."
        raise SceneError("the textures are too large together", path=path, value=f"{n_pixels:,} pixels", fix=fix)


def _sibling(path: Path, name: str) -> Path:
    """A file that a mesh names. Raises SceneError unless it exists, in the mesh's folder or a subfolder."""
    file = path.parent / name
    if not Path(os.path.normpath(file)).is_relative_to(os.path.normpath(path.parent)) or not file.is_file():
        fix = "Put it into the mesh's folder, under the name that the mesh gives it."
        raise SceneError("a file of the scene is missing, or outside of its folder", path=path, value=name, fix=fix)
    return file


def _glb_textures(path: Path) -> Iterator[Path | bytes]:
    """Images of a binary glTF 2.0 file (specification, section 4.4): sibling files, or their content."""
    content = path.read_bytes()
    magic, version, length, json_length, _ = struct.unpack_from("<4sIIII", content)
    if magic != b"glTF" or version != 2 or length != len(content):
        raise ValueError(f"it is not glTF 2.0, or has {len(content)} of {length} bytes")
    tree = parse_json_object(content[20 : 20 + json_length].decode())
    for accessor in tree.get("accessors", []):
        if not 0 < accessor["count"] <= max_expanded_bytes(length) // _LARGEST_ELEMENT:
            raise ValueError(f"an accessor has {accessor['count']} elements")
    nodes = tree.get("nodes", [])
    _check_nodes(nodes)
    _check_corners(tree, nodes)
    buffers = [content[28 + json_length :]]
    for buffer in tree.get("buffers", []):
        source = _at_uri(buffer["uri"], path) if "uri" in buffer else buffers[0]
        buffers.append(source.read_bytes() if isinstance(source, Path) else source)
    for image in tree.get("images", []):
        if "bufferView" in image:
            view = tree["bufferViews"][image["bufferView"]]
            start = view.get("byteOffset", 0)
            yield buffers[1 + view["buffer"]][start : start + view["byteLength"]]
        else:
            yield _at_uri(image["uri"], path)


def _check_nodes(nodes: list[Any]) -> None:
    """Raise ValueError if there are too many nodes, one has two parents, or they are nested too deeply or in a cycle."""
    if len(nodes) > MAX_NODES:
        raise ValueError(f"{len(nodes):,} nodes; join them to {MAX_NODES:,}")
    parents: dict[int, int] = {}
    for parent, node in enumerate(nodes):
        for child in node.get("children", []):
            if parents.setdefault(child, parent) != parent:
                raise ValueError(f"node {child} has two parents")
    for node in parents:
        ancestor = node
        for _ in range(MAX_DEPTH):
            if ancestor not in parents:
                break
            ancestor = parents[ancestor]
        else:
            raise ValueError(f"nodes are nested deeper than {MAX_DEPTH}")


def _check_corners(tree: dict[str, Any], nodes: list[Any]) -> None:
    """Raise ValueError if the triangles of all nodes, which can share a mesh, do not fit into memory."""
    n_corners = []
    for mesh in tree.get("meshes", []):
        accessors = [part.get("indices", part["attributes"]["POSITION"]) for part in mesh["primitives"]]
        n_corners.append(sum(tree["accessors"][number]["count"] for number in accessors))
    n_total = sum(n_corners[node["mesh"]] for node in nodes if "mesh" in node)
    if n_total > fitting(BYTES_PER_CORNER):
        raise ValueError(f"its nodes have {n_total // 3:,} triangles together")


def _at_uri(uri: str, path: Path) -> Path | bytes:
    """The file, or the content of a `data:` URI, that the mesh at `path` names."""
    kind, _, content = uri.partition(",")
    if not kind.startswith("data:"):
        return _sibling(path, uri)
    if not kind.endswith(";base64"):
        raise ValueError(f"a URI without base64, {kind[:40]!r}")
    return base64.b64decode(content, validate=True)


def _ply_textures(path: Path) -> Iterator[Path | bytes]:
    """Textures that a PLY file names in comments. Raises ValueError if it announces more elements than bytes."""
    with path.open("rb") as file:
        header, end, _ = file.read(MAX_PLY_HEADER).partition(b"end_header")
    if not header.startswith(b"ply") or not end:
        raise ValueError(f"a PLY header does not end within {MAX_PLY_HEADER:,} bytes")
    for line in header.decode("utf-8", errors="replace").splitlines():
        words = line.split()
        if words[:1] == ["element"] and not 0 <= int(words[2]) <= path.stat().st_size:
            raise ValueError(f"it cannot hold {words[2][:20]} elements")
        if line.lower().startswith("comment texturefile "):
            yield _sibling(path, line.strip()[len("comment texturefile ") :].strip())


def _obj_textures(path: Path) -> Iterator[Path | bytes]:
    """Textures that an OBJ file's materials name. Raises ValueError if the file has too many parts."""
    parts = dict.fromkeys(("usemtl", "o", "g"), 0)
    libraries = []
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            if line.startswith("mtllib "):
                libraries.append(line[7:].strip())
            elif line.startswith(("usemtl ", "o ", "g ")):
                parts[line.split(maxsplit=1)[0]] += 1
    if max(parts.values()) > MAX_PARTS:
        raise ValueError(f"{max(parts.values()):,} parts; join them to {MAX_PARTS:,}, or export a GLB file")
    for name in libraries:
        library = _sibling(path, name)
        for line in read_text(library, MAX_MTL_BYTES).splitlines():
            # A map with options (-s, -o ...) before its file name is not checked.
            words = line.split(maxsplit=1)
            if len(words) == 2 and words[0].lower() == "map_kd" and not words[1].startswith("-"):
                yield _sibling(library, words[1].strip().replace("\\", "/"))
