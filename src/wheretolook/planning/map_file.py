"""Viewpoint maps on disk: a folder of plain arrays that any language can read, and a description of their layout."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.utils.errors import MapFormatError
from wheretolook.utils.files import atomic_folder, sha256, write_json, write_text
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
"""Little-endian type, shape and meaning of each array; each is a file `<name>.npy`."""

_WAIT_S = 120.0  # for another process that writes into the same folder

REBUILD = "Build it again with `wheretolook viewpoint-map`, or get the folder again."

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
  let `update_viewpoint_map` know which landmarks were added; a planner has no use for them.
"""


def write_map(
    folder: str | Path, grid: VoxelGrid, origin: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> None:
    """Write a viewpoint map into a folder; a folder that holds nothing but another one is replaced in one step.

    The same map gives the same bytes; the folder's own `LAYOUT.txt` describes them. Processes that have mapped the old
    files into memory still read them.

    `origin` has the fields of `MapOrigin` but `derived`, `arrays` those of `ARRAYS` by name. Raises MapFormatError if
    the folder holds anything that is not part of a viewpoint map.
    """
    folder = Path(folder).resolve()  # so that "." has a name too
    _check_replaceable(folder)
    with hold(folder.with_name(f".{folder.name}.lock"), "viewpoint map", wait_s=_WAIT_S), atomic_folder(folder) as new:
        _write(new, grid, origin, arrays)


def _check_replaceable(folder: Path) -> None:
    """Raise MapFormatError unless a folder is missing, empty, or holds a viewpoint map of any version and only that."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    try:
        is_map = read_json(folder / DESCRIPTION)["format"] == FORMAT
    except (OSError, ValueError, LookupError, TypeError):
        is_map = False
    files = {DESCRIPTION, LAYOUT, *(f"{name}.npy" for name in ARRAYS)}
    if not is_map or not files >= {path.name for path in folder.iterdir()}:
        fix = "Name a new folder, or remove this."
        raise MapFormatError("the folder holds something else than a viewpoint map", path=folder, fix=fix)


def _write(folder: Path, grid: VoxelGrid, origin: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
    checksums = {}
    for name, (kind, _, _) in ARRAYS.items():
        save_npy(folder / f"{name}.npy", np.ascontiguousarray(arrays[name], dtype=kind))
        checksums[f"{name}.npy"] = sha256(folder / f"{name}.npy")
    files = "\n".join(
        f"  {name + '.npy':<20}{np.dtype(kind).name:<9}({shape + ')':<7}{meaning}"
        for name, (kind, shape, meaning) in ARRAYS.items()
    )
    write_text(folder / LAYOUT, _TEXT.format(version=VERSION, files=files))
    n_rows, n_directions = arrays["scores"].shape
    content = {
        "format": FORMAT,
        "version": VERSION,
        "grid": {name: np.asarray(getattr(grid, name)).tolist() for name in ("lower", "upper", "shape")},
        "sizes": {"V": len(grid), "L": n_rows, "D": n_directions, "N": len(arrays["landmark_ids"])},
        "origin": dict(origin),
        "sha256": checksums,
    }
    write_json(folder / DESCRIPTION, content)


def read_map(folder: str | Path, mmap: bool = False) -> tuple[VoxelGrid, dict[str, Any], dict[str, NDArray[Any]]]:
    """Read the grid, origin and arrays that `write_map` wrote.

    With `mmap` the files are mapped into memory, read-only: sizes and types are checked, but not the checksums, for
    which every byte would have to be read. Raises MapFormatError if there is no map, or it is damaged or of another
    version.
    """
    folder = Path(folder)
    path = folder / DESCRIPTION
    if not path.is_file():
        raise MapFormatError("there is no viewpoint map in this folder", path=folder, fix=REBUILD)
    try:
        content = read_json(path)
        if (content["format"], content["version"]) != (FORMAT, VERSION):
            raise ValueError(f"not a viewpoint map of version {VERSION}")
        bounds = np.array([content["grid"]["lower"], content["grid"]["upper"]], dtype=np.float64)
        nx, ny, nz = (int(side) for side in content["grid"]["shape"])
        grid = VoxelGrid.over(bounds, (nx, ny, nz))
        origin, sizes, checksums = (dict(content[name]) for name in ("origin", "sizes", "sha256"))
        sizes["V"] = nx * ny * nz
        shapes = {
            name: tuple(int(sizes.get(side, side)) for side in text.split(", "))
            for name, (_, text, _) in ARRAYS.items()
        }
    except Exception as error:  # any value may be damaged
        raise MapFormatError(f"damaged description: {error}", path=path, fix=REBUILD) from error
    arrays: dict[str, NDArray[Any]] = {}
    for name, shape in shapes.items():
        file = folder / f"{name}.npy"
        arrays[name] = _read(file, ARRAYS[name][0], shape, mmap)
        if not mmap and sha256(file) != checksums.get(file.name):
            raise MapFormatError("damaged: the checksum differs", path=file, fix=REBUILD)
    return grid, origin, arrays


def _read(path: Path, kind: str, shape: tuple[int, ...], mmap: bool) -> NDArray[Any]:
    try:
        # a plain array over the mapped memory, because np.memmap is slow to index
        array = np.asarray(np.load(path, mmap_mode="r" if mmap else None, allow_pickle=False))
    except Exception as error:  # a damaged header raises many kinds of errors
        raise MapFormatError(f"not a readable array: {error}", path=path, fix=REBUILD) from error
    if array.shape != shape or array.dtype != np.dtype(kind) or not array.flags.c_contiguous:
        problem = f"not an array of {np.dtype(kind).name} of shape {shape}"
        raise MapFormatError(problem, path=path, value=(array.dtype.name, array.shape), fix=REBUILD)
    return array
