"""Finds images that a mesh file refers to and that cannot be read.

trimesh leaves such images out, or puts a grey placeholder in their place, without an error.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

from wheretolook.utils.errors import SceneError

_READABLE = ("image/png", "image/jpeg", "image/webp")


def check_texture_references(path: Path) -> None:
    """Raise SceneError if a GLB, PLY or OBJ file refers to a texture that is missing or in a format not supported."""
    suffix = path.suffix.lower()
    if suffix == ".glb":
        for image in _glb_json(path).get("images", []):
            mime_type = image.get("mimeType", "")
            if "bufferView" in image and mime_type not in _READABLE:
                fix = "Use the GLB with JPEG or PNG textures; a .basis.glb holds compressed ones"
                raise SceneError("a texture is in a format that is not supported", path=path, value=mime_type, fix=fix)
        return
    for texture in _ply_textures(path) if suffix == ".ply" else _obj_textures(path):
        if not texture.is_file():
            fix = "Put the image where the mesh expects it"
            raise SceneError("a texture is missing", path=path, value=str(texture), fix=fix)


def _glb_json(path: Path) -> dict[str, Any]:
    """The JSON chunk of a binary glTF 2.0 file (glTF 2.0 specification, section 4.4)."""
    fix = "Check that the file was copied whole"
    with path.open("rb") as file:
        header = file.read(20)
        if len(header) < 20 or header[:4] != b"glTF":
            raise SceneError("not a binary glTF file", path=path, fix=fix)
        _, version, length, json_length, _ = struct.unpack("<4sIIII", header)
        if length != path.stat().st_size or version != 2:
            value = f"{path.stat().st_size} of {length} bytes, version {version}"
            raise SceneError("a truncated glTF file or not of version 2", path=path, value=value, fix=fix)
        try:
            content: dict[str, Any] = json.loads(file.read(json_length))
        except ValueError as error:
            raise SceneError("the glTF file is corrupt", path=path, value=str(error)) from error
        return content


def _ply_textures(path: Path) -> list[Path]:
    with path.open("rb") as file:
        for raw in file:
            line = raw.decode("utf-8", errors="replace").strip()
            if line.lower().startswith("comment texturefile "):
                return [path.parent / line[len("comment texturefile ") :].strip()]
            if line == "end_header":
                break
    return []


def _obj_textures(path: Path) -> list[Path]:
    textures = []
    with path.open(encoding="utf-8", errors="replace") as file:
        libraries = [path.parent / line[7:].strip() for line in file if line.startswith("mtllib ")]
    for library in libraries:
        if not library.is_file():
            fix = "Put it where the mesh expects it"
            raise SceneError("the material library is missing", path=path, value=str(library), fix=fix)
        for line in library.read_text(encoding="utf-8", errors="replace").splitlines():
            # A map with options (-s, -o ...) before its file name is not checked.
            words = line.split(maxsplit=1)
            if len(words) == 2 and words[0].lower() == "map_kd" and not words[1].startswith("-"):
                textures.append(library.parent / words[1].strip().replace("\\", "/"))
    return textures
