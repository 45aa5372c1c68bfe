"""A viewpoint map on disk: a folder of plain arrays that any language can read, and a description of their layout."""

from __future__ import annotations

import glob
import math
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.utils.errors import MapFormatError
from wheretolook.utils.files import moved_later, sha256, storage_errors, write_json, write_text
from wheretolook.utils.locks import hold
from wheretolook.utils.npz_files import save_npy
from wheretolook.utils.reading import read_json

FORMAT = "wheretolook viewpoint map"
VERSION = 1

DESCRIPTION = "viewpoint_map.json"
LAYOUT = "LAYOUT.txt"

ARRAYS = {
    "row_of_voxel": ("<i4", "V", "row of each voxel in the arrays by row, -1 if it is not free"),
    "directions": ("<f8", "D, 3", "unit optical axes in the world"),
    "ranked": ("<u2", "L, D", "ids of the directions, the best first"),
    "scores": ("<f4", "L, D", "by direction id"),
    "n_visible": ("<u4", "L, D", "landmarks in view, by direction id"),
    "landmark_ids": ("<i8", "N", "of the map's landmarks, ascending"),
    "landmark_digests": ("<u8", "N, 2", "of these"),
}
"""Type, little-endian, shape and meaning of each array; each is a file `<name>.npy`."""

_MOST_VOXELS = 2**40

_OLD = "old"  # name of a map that is being replaced, in the hidden folder where the new one is written
_NEW = "new"  # name of the new one there
_WAIT_S = 120.0  # for another process to write its map into the same folder

REBUILD = "Build it anew with `wheretolook viewpoint-map`, or get the folder again."

_TEXT = """\
A viewpoint map, version {version}: where to point a camera so that it knows where it is.

For every free voxel of a scene, every direction of a lattice is ranked by how well a camera there would localize.

FRAMES AND UNITS
  World: metres, z up. A direction is the unit vector, in the world, that the camera's optical axis points along. The
  camera (x right, y down, z forward) does not roll: its x axis is level. If it looks straight up or down, x is world x.
  With direction f, the rows of the rotation cam_from_world are
    right = (f.y, -f.x, 0) / |(f.y, -f.x, 0)|,  down = f x right,  forward = f.

FILES
  viewpoint_map.json  format, version, grid, sizes, and what the map was made from
{files}
  V voxels, L free voxels, D directions, N landmarks; the numbers are in viewpoint_map.json under "sizes".

  Arrays are .npy files, version 1.0: 6 bytes magic, 2 bytes version, then H as a little-endian uint16, then H bytes of
  text, then the values from byte 10 + H on (a multiple of 64, so a file can be memory-mapped as it is): little-endian,
  row-major, not compressed.

FROM A POINT TO ITS VOXEL
  "grid" has lower and upper (corners, metres) and shape (voxels along x, y, z). For p within lower and upper, both
  included, and for each axis a:
    i[a] = min(floor((p[a] - lower[a]) / size[a]), shape[a] - 1),  size[a] = (upper[a] - lower[a]) / shape[a]
    voxel = (i[x] * shape[y] + i[y]) * shape[z] + i[z]
    row = row_of_voxel[voxel]; -1: not free, there is nothing here for a camera. Rows count up with voxels.
  Scores were computed at the voxel's centre, lower + (i + 0.5) * size.

FROM A ROW TO ITS DIRECTIONS
  ranked[row * D + k] is the id of the k-th best direction, k = 0 the best; ties go by rising id.
  scores[row * D + id], n_visible[row * D + id] and directions[id * 3 + axis] belong to a direction's id.
  A score is what the scorer under "origin" gives: a calibrated probability if the scorer's is one. It is stored in
  single precision; the ranks are those of the double. n_visible is the number of landmarks in view.

IN C++, the best direction at a point (for little-endian machines):

  template <class T> const T* values(const char* npy) {{   // npy: the whole file, mapped or read
    return reinterpret_cast<const T*>(npy + 10 + (uint8_t(npy[8]) | uint8_t(npy[9]) << 8));
  }}
  int64_t voxel = 0;
  for (int a = 0; a < 3; ++a) {{
    if (!(p[a] >= lower[a] && p[a] <= upper[a])) return -1;
    double size = (upper[a] - lower[a]) / shape[a];
    voxel = voxel * shape[a] + std::min<int64_t>((p[a] - lower[a]) / size, shape[a] - 1);
  }}
  int32_t row = values<int32_t>(row_of_voxel_npy)[voxel];
  return row < 0 ? -1 : values<uint16_t>(ranked_npy)[row * int64_t(D)];

TO UPDATE
  landmark_ids and landmark_digests (of each landmark's position, and of its attributes: the first 8 bytes of BLAKE2b)
  tell `update_viewpoint_map` which landmarks were added; a planner has no use for them.
"""


def write_map(
    folder: str | Path, grid: VoxelGrid, origin: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> None:
    """Write a folder; one that holds a viewpoint map and nothing else is replaced once the new one is complete.

    The same map gives the same bytes; the folder's own `LAYOUT.txt` describes them. The new map is written in a hidden
    folder beside it, `.<name>.<some letters>`, into which the old one is moved until the new one is in place. A process
    killed in between leaves both there, and `read_map` says where; one killed earlier leaves part of the new one, which
    the next one that writes here removes. They wait for one another.

    `origin` has the fields of `MapOrigin` but `derived`, `arrays` those of `ARRAYS` by name. Raises MapFormatError if
    the folder holds anything that is not part of a viewpoint map.
    """
    folder = Path(folder).resolve()  # so that "." has a name too
    _refuse_something_else(folder)
    with hold(folder.with_name(f".{folder.name}.lock"), "viewpoint map", wait_s=_WAIT_S):
        for left in folder.parent.glob(f".{glob.escape(folder.name)}.????????"):
            inside = {path.name for path in left.iterdir()} if left.is_dir() and not left.is_symlink() else {"a file"}
            if inside <= {_NEW} or (inside <= {_NEW, _OLD} and (folder / DESCRIPTION).is_file()):
                shutil.rmtree(left, ignore_errors=True)  # of a process that was killed while it wrote, or afterwards
        with storage_errors(folder):
            work = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        new = work / _NEW
        old = work / _OLD
        try:
            with moved_later(new, folder), storage_errors(folder):
                new.mkdir()
                _write(new, grid, origin, arrays)
            if folder.exists():
                folder.rename(old)
            new.rename(folder)
        finally:
            if old.exists() and not folder.exists():
                old.rename(folder)
            try:
                shutil.rmtree(work, ignore_errors=True)  # processes that have mapped the old files still read them
            except KeyboardInterrupt:
                shutil.rmtree(work, ignore_errors=True)
                raise


def _refuse_something_else(folder: Path) -> None:
    """Raise MapFormatError unless a folder is missing, empty, or holds a viewpoint map of any version and only that."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    try:
        is_map = read_json(folder / DESCRIPTION)["format"] == FORMAT
    except (OSError, ValueError, LookupError, TypeError):
        is_map = False
    if not is_map:
        raise MapFormatError("something else is here", path=folder, fix="Name a new folder, or remove this.")
    known = {DESCRIPTION, LAYOUT, *(f"{name}.npy" for name in ARRAYS)}
    for name in sorted(path.name for path in folder.iterdir() if path.name not in known):
        fix = "Move it elsewhere, or name a new folder for the map."
        raise MapFormatError("this is no file of the viewpoint map that is to be replaced", path=folder / name, fix=fix)


def _write(folder: Path, grid: VoxelGrid, origin: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
    checksums = {}
    for name, (kind, _, _) in ARRAYS.items():
        save_npy(folder / f"{name}.npy", np.ascontiguousarray(arrays[name], dtype=kind))
        checksums[f"{name}.npy"] = sha256(folder / f"{name}.npy")
    n_rows, n_directions = arrays["scores"].shape
    files = "\n".join(
        f"  {name + '.npy':<20}{np.dtype(kind).name:<9}({shape + ')':<7}{meaning}"
        for name, (kind, shape, meaning) in ARRAYS.items()
    )
    write_text(folder / LAYOUT, _TEXT.format(version=VERSION, files=files))
    corners = {name: [*map(float, getattr(grid, name))] for name in ("lower", "upper")}
    content = {"format": FORMAT, "version": VERSION, "grid": {**corners, "shape": [*map(int, grid.shape)]}}
    sizes = {"V": len(grid), "L": n_rows, "D": n_directions, "N": len(arrays["landmark_ids"])}
    write_json(folder / DESCRIPTION, {**content, "sizes": sizes, "origin": dict(origin), "sha256": checksums})


def read_map(folder: str | Path, mmap: bool = False) -> tuple[VoxelGrid, dict[str, Any], dict[str, NDArray[Any]]]:
    """Read what `write_map` wrote: grid, origin and arrays.

    With `mmap` the files are mapped into memory, read-only, and read where they are used. Sizes and types are still
    checked, but not the checksums, for which every byte would have to be read. Raises MapFormatError if there is no
    map, or it is damaged or of another version.
    """
    folder = Path(folder)
    path = folder / DESCRIPTION
    if not path.is_file():
        fix = _left_behind(folder) or REBUILD
        raise MapFormatError("there is no viewpoint map in this folder", path=folder, fix=fix)
    try:
        content = read_json(path)
        found = content.get("format"), content.get("version")
    except (OSError, ValueError, AttributeError) as error:
        raise MapFormatError(f"damaged description: {error}", path=path, fix=REBUILD) from error
    if found != (FORMAT, VERSION):
        raise MapFormatError(f"not a viewpoint map of version {VERSION}", path=path, value=found, fix=REBUILD)
    try:
        corners = content["grid"]
        grid = VoxelGrid(tuple(corners["lower"]), tuple(corners["upper"]), tuple(corners["shape"]))
        lengths = {len(values) for values in (grid.lower, grid.upper, grid.shape)}
        whole = all(type(side) is int for side in grid.shape)
        if not whole or lengths != {3} or math.prod(grid.shape) > _MOST_VOXELS:
            raise ValueError(f"a grid of shape {grid.shape} between {grid.lower} and {grid.upper}")
        origin, sizes, checksums = (dict(content[name]) for name in ("origin", "sizes", "sha256"))
        sides = {name: shape.split(", ") for name, (_, shape, _) in ARRAYS.items()}
        expected = {name: tuple(int(sizes.get(side, side)) for side in sides[name]) for name in ARRAYS}
    except Exception as error:  # any value may be damaged
        raise MapFormatError(f"damaged description: {error}", path=path, fix=REBUILD) from error
    arrays: dict[str, NDArray[Any]] = {}
    for name, shape in expected.items():
        arrays[name] = _read(folder / f"{name}.npy", ARRAYS[name][0], shape, mmap)
        if not mmap and sha256(folder / f"{name}.npy") != checksums.get(f"{name}.npy"):
            raise MapFormatError("damaged: the checksum differs", path=folder / f"{name}.npy", fix=REBUILD)
    return grid, origin, arrays


def _left_behind(folder: Path) -> str:
    """Where an interrupted save left the map that it was about to replace, as a sentence; "" if there is none."""
    folder = folder.resolve()
    found = sorted(folder.parent.glob(f".{glob.escape(folder.name)}.*/{_OLD}/{DESCRIPTION}"))
    return f"A save was interrupted: the map from before is {found[-1].parent}, move it here." if found else ""


def _read(path: Path, kind: str, shape: tuple[int, ...], mmap: bool) -> NDArray[Any]:
    if not path.is_file():
        raise MapFormatError("this file is missing", path=path, fix=REBUILD)
    try:
        # a plain array over the mapped memory, because np.memmap is slow to index
        array = np.asarray(np.load(path, mmap_mode="r" if mmap else None, allow_pickle=False))
    except Exception as error:  # a damaged header raises many kinds of errors
        raise MapFormatError(f"not a readable array: {error}", path=path, fix=REBUILD) from error
    if array.shape != shape or array.dtype != np.dtype(kind) or not array.flags.c_contiguous:
        problem = f"not an array of {np.dtype(kind).name} of shape {shape}"
        raise MapFormatError(problem, path=path, value=(array.dtype.name, array.shape), fix=REBUILD)
    return array
