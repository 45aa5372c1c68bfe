"""Checks of PLY and OBJ files, and of the textures that a mesh names, before a parser believes them."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

from PIL import Image

from wheretolook.utils.errors import SceneError
from wheretolook.utils.memory import fitting
from wheretolook.utils.reading import check_file

MAX_PLY_HEADER = 1 << 16  # bytes
MAX_MTL_BYTES = 16_000_000
MAX_PARTS = 5000  # of an OBJ file; trimesh takes the square of their number
BYTES_PER_PIXEL = 11  # of a texture, while it is read
_EXPORT = "Export the scene again"


def check_image(image: BinaryIO | Path, name: str, path: Path) -> int:
    """The number of pixels of a texture of the mesh at `path`.

    Raises SceneError if Pillow cannot open it, which trimesh would leave out without an error, or takes it for a bomb.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # it is refused below
            with Image.open(image) as opened:
                pixels = opened.width * opened.height
    except Exception as error:  # decoders raise errors of many kinds
        fix = f"{_EXPORT}, with textures of {_most_pixels():,} pixels at most"
        raise SceneError(f"{name} is damaged or too large", path=path, value=str(error)[:200], fix=fix) from error
    if pixels > _most_pixels():
        fix = f"Scale it down to {_most_pixels():,} pixels or fewer"
        raise SceneError(f"{name} is too large", path=path, value=f"{pixels:,} pixels", fix=fix)
    return pixels


def _most_pixels() -> int:
    return Image.MAX_IMAGE_PIXELS or 2**27


def check_all_images(pixels: Iterable[int], path: Path) -> None:
    """Raise SceneError if memory does not hold textures of so many pixels each."""
    total = sum(pixels)
    most = fitting(BYTES_PER_PIXEL)
    if total > most:
        fix = f"Scale them down: there is room for {most:,} pixels"
        raise SceneError("the textures are too large together", path=path, value=f"{total:,} pixels", fix=fix)


def check_texture_file(texture: Path, path: Path) -> int:
    """The number of pixels of a texture in a file of its own.

    Raises SceneError unless it is an image that Pillow opens, in the folder of the mesh at `path` or in one in it.
    """
    if not Path(os.path.normpath(texture)).is_relative_to(os.path.normpath(path.parent)):
        fix = "Put the image into the mesh's folder, and name it so there"
        raise SceneError("a texture lies outside of the mesh's folder", path=path, value=str(texture), fix=fix)
    if not texture.is_file():
        fix = "Put the image where the mesh expects it"
        raise SceneError("a texture is missing", path=path, value=str(texture), fix=fix)
    return check_image(texture, f"the texture {texture.name}", path)


def check_ply(path: Path) -> list[Path]:
    """The textures that a PLY file names.

    Raises SceneError if it has no header of a bounded length, or counts more elements than the file holds.
    """
    with path.open("rb") as file:
        start = file.read(MAX_PLY_HEADER)
    header, end, _ = start.partition(b"end_header")
    if not start.startswith(b"ply") or not end:
        problem = f"the mesh cannot be read: a PLY header does not end within {MAX_PLY_HEADER:,} bytes"
        raise SceneError(problem, path=path, fix="Check that the file was copied whole")
    textures = []
    for line in header.decode("utf-8", errors="replace").splitlines():
        words = line.split()
        if words[:1] == ["element"]:
            count = int(words[2]) if len(words) == 3 and words[2].isdecimal() and len(words[2]) < 20 else -1
            if not 0 <= count <= path.stat().st_size:  # each takes a byte at least
                problem = "the PLY file is truncated or corrupt: it holds no such number of elements"
                raise SceneError(problem, path=path, value=" ".join(words[1:])[:80], fix=_EXPORT)
        elif line.lower().startswith("comment texturefile "):
            textures.append(path.parent / line.strip()[len("comment texturefile ") :].strip())
    return textures


def check_obj(path: Path) -> list[Path]:
    """The textures that an OBJ file's materials name.

    Raises SceneError if a library of materials is missing, damaged, or outside of the mesh's folder, or the file has
    too many parts.
    """
    textures = []
    libraries = []
    parts = dict.fromkeys(("usemtl", "o", "g"), 0)
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            if line.startswith("mtllib "):
                libraries.append(path.parent / line[7:].strip())
            elif line.startswith(("usemtl ", "o ", "g ")):
                parts[line.split(maxsplit=1)[0]] += 1
    if max(parts.values()) > MAX_PARTS:
        fix = f"Join its parts to {MAX_PARTS:,} at most, or export a GLB file"
        raise SceneError("the OBJ file has too many parts", path=path, value=max(parts.values()), fix=fix)
    for library in libraries:
        if not library.is_file():
            fix = "Put it where the mesh expects it"
            raise SceneError("the material library is missing", path=path, value=str(library), fix=fix)
        if check_file(library).st_size > MAX_MTL_BYTES:
            problem = f"the material library has more than {MAX_MTL_BYTES:,} bytes"
            raise SceneError(problem, path=library, value=library.stat().st_size, fix=_EXPORT)
        for line in library.read_text(encoding="utf-8", errors="replace").splitlines():
            # A map with options (-s, -o ...) before its file name is not checked.
            words = line.split(maxsplit=1)
            if len(words) == 2 and words[0].lower() == "map_kd" and not words[1].startswith("-"):
                textures.append(library.parent / words[1].strip().replace("\\", "/"))
    return textures
