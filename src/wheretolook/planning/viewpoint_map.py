"""Viewpoint maps on disk: a folder of plain arrays that any language can read, and a description of their layout."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wheretolook.geometry.lattices import VoxelGrid
from wheretolook.geometry.poses import (
    Float,
    angles_to_axis_deg,
    check_axis,
    rotation_looking_along,
    turns_from_deg,
    within,
)
from wheretolook.geometry.similarity import Similarity
from wheretolook.geometry.views import Views
from wheretolook.looks.selection import best_views
from wheretolook.utils.errors import ConfigError, MapFormatError
from wheretolook.utils.files import atomic_folder, read_json, save_npy, sha256, write_json, write_text
from wheretolook.utils.processes import hold

if TYPE_CHECKING:
    from wheretolook.scorers.base import Scorer


FORMAT = "wheretolook viewpoint map"
VERSION = 2

DESCRIPTION = "viewpoint_map.json"
LAYOUT = "LAYOUT.txt"

ARRAYS = {
    "row_of_voxel": ("<i4", "V", "row of each voxel in the arrays by row, -1 if it is not free"),
    "directions": ("<f8", "D, 3", "unit optical axes in the map's own frame"),
    "ranked": ("<u2", "L, D", "ids of the directions, the best first"),
    "scores": ("<f4", "L, D", "by direction id"),
    "n_visible": ("<u4", "L, D", "landmarks in view, by direction id"),
    "landmark_ids": ("<i8", "N", "of the map's landmarks, ascending"),
    "landmark_digests": ("<u8", "N, 2", "of these"),
}
"""Little-endian type, shape and meaning of each array; each is a file `<name>.npy`."""


REBUILD = "Build it again with `wheretolook viewpoint-map`, or get the folder again."

_TEXT = """\
A viewpoint map, version {version}: where to point a camera so that it knows where it is.

For every free voxel of a scene, every direction of a lattice is ranked by how well a camera there would localize.

FRAMES AND UNITS
  Points and directions are in the own frame and unit of the model that the map was made from. The grid is in the world:
  metres, z up. With the numbers under "frame" in viewpoint_map.json (rotation by rows)
    world = scale * rotation * point + translation.
  A direction is the unit vector that the camera's optical axis points along. The camera (x right, y down, z forward)
  does not roll: its x axis is level. If it looks straight up or down, x is world x.
  With f = rotation * direction, the rows of the rotation cam_from_world are
    right = (f.y, -f.x, 0) / |(f.y, -f.x, 0)|,  down = f x right,  forward = f.

FILES
  viewpoint_map.json  format, version, grid, sizes, and what the map was made from
{files}
  V voxels, L free voxels, D directions, N landmarks; the numbers are in viewpoint_map.json under "sizes".

  Arrays are .npy files, version 1.0: 6 bytes magic, 2 bytes version, then H as a little-endian uint16, then H bytes of
  text, then the values from byte 10 + H on (a multiple of 64, so a file can be memory-mapped as it is): little-endian,
  row-major, not compressed.

FROM A POINT TO ITS VOXEL
  "grid" has lower and upper (corners, metres) and shape (voxels along x, y, z). For w, the point in the world, within
  lower and upper, both included, and for each axis a:
    i[a] = min(floor((w[a] - lower[a]) / size[a]), shape[a] - 1),  size[a] = (upper[a] - lower[a]) / shape[a]
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
    const double* r = rotation[a];
    double w = scale * (r[0] * p[0] + r[1] * p[1] + r[2] * p[2]) + translation[a];
    if (!(w >= lower[a] && w <= upper[a])) return -1;
    double size = (upper[a] - lower[a]) / shape[a];
    voxel = voxel * shape[a] + std::min<int64_t>((w - lower[a]) / size, shape[a] - 1);
  }}
  int32_t row = values<int32_t>(row_of_voxel_npy)[voxel];
  return row < 0 ? -1 : values<uint16_t>(ranked_npy)[row * int64_t(D)];

LANDMARKS
  landmark_ids and landmark_digests (of each landmark's position, and of its attributes: the first 8 bytes of BLAKE2b)
  identify the landmarks that the map was built from; a planner has no use for them.
"""


def write_map(
    folder: str | Path,
    grid: VoxelGrid,
    world_from_map: Similarity,
    origin: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
) -> None:
    """Write a viewpoint map into a folder; a folder that holds nothing but another one is replaced in one step.

    The same map gives the same bytes; the folder's own `LAYOUT.txt` describes them. Processes that have mapped the old
    files into memory still read them.

    `origin` has the fields of `MapOrigin` but `derived`, `arrays` those of `ARRAYS` by name. Raises MapFormatError if
    the folder holds anything that is not part of a viewpoint map.
    """
    folder = Path(folder).resolve()  # so that "." has a name too
    _check_replaceable(folder)
    with hold(folder.with_name(f".{folder.name}.lock"), "viewpoint map", wait_s=120.0), atomic_folder(folder) as new:
        checksums = {}
        for name, (kind, _, _) in ARRAYS.items():
            save_npy(new / f"{name}.npy", np.ascontiguousarray(arrays[name], dtype=kind))
            checksums[f"{name}.npy"] = sha256(new / f"{name}.npy")
        files = "\n".join(
            f"  {name + '.npy':<20}{np.dtype(kind).name:<9}({shape + ')':<7}{meaning}"
            for name, (kind, shape, meaning) in ARRAYS.items()
        )
        write_text(new / LAYOUT, _TEXT.format(version=VERSION, files=files))
        n_rows, n_directions = arrays["scores"].shape
        content = {
            "format": FORMAT,
            "version": VERSION,
            "grid": {name: np.asarray(getattr(grid, name)).tolist() for name in ("lower", "upper", "shape")},
            "frame": world_from_map.record(),
            "sizes": {"V": len(grid), "L": n_rows, "D": n_directions, "N": len(arrays["landmark_ids"])},
            "origin": dict(origin),
            "sha256": checksums,
        }
        write_json(new / DESCRIPTION, {**content, "digest": _digest(content)})


def _digest(description: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a description, apart from this digest."""
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()


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


def read_map(
    folder: str | Path, mmap: bool = False
) -> tuple[VoxelGrid, Similarity, dict[str, Any], dict[str, NDArray[Any]]]:
    """Read the grid, the transformation from the map's own frame, the origin and the arrays that `write_map` wrote.

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
        if content.pop("digest") != _digest(content):
            raise ValueError("changed since it was written")
        bounds = np.array([content["grid"]["lower"], content["grid"]["upper"]], dtype=np.float64)
        nx, ny, nz = (int(side) for side in content["grid"]["shape"])
        grid = VoxelGrid.over(bounds, (nx, ny, nz))
        frame = content["frame"]
        world_from_map = Similarity(frame["scale"], np.array(frame["rotation"]), np.array(frame["translation"]))
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
    return grid, world_from_map, origin, arrays


def _read(path: Path, kind: str, shape: tuple[int, ...], mmap: bool) -> NDArray[Any]:
    if not path.is_file():  # a pipe would never end
        raise MapFormatError("missing, or not a file", path=path, fix=REBUILD)
    try:
        # a plain array over the mapped memory, because np.memmap is slow to index
        array = np.asarray(np.load(path, mmap_mode="r" if mmap else None, allow_pickle=False))
    except Exception as error:  # a damaged header raises many kinds of errors
        raise MapFormatError(f"not a readable array: {error}", path=path, fix=REBUILD) from error
    if array.shape != shape or array.dtype != np.dtype(kind) or not array.flags.c_contiguous:
        problem = f"not an array of {np.dtype(kind).name} of shape {shape}"
        raise MapFormatError(problem, path=path, value=(array.dtype.name, array.shape), fix=REBUILD)
    return array


Point = Sequence[float] | NDArray[Any]


class ViewChoice(NamedTuple):
    """One orientation at a voxel.

    Attributes:
        direction_id: row in the map's directions.
        axis: (3,) unit optical axis in the map's own frame, read-only; the camera does not roll.
        score: by the map's scorer.
        n_visible: number of landmarks in view from the voxel's centre.
    """

    direction_id: int
    axis: Float
    score: float
    n_visible: int


@dataclass(frozen=True)
class MapOrigin:
    """Origin of a viewpoint map.

    Attributes:
        scorer: name of the method.
        lattice: name of the directions' lattice, "" for others.
        camera: COLMAP's "model", "width" and "height" in pixels, and "params".
        occlusion: name of the occlusion model.
        landmarks: 16 hexadecimal digits that change with any landmark.
        derived: changes of the map since it was built, such as scores replaced by ranks. A derived map answers
            queries, but cannot be saved.
    """

    scorer: str
    lattice: str
    camera: dict[str, Any]
    occlusion: str
    landmarks: str
    derived: str = ""

    def derive(self, change: str) -> MapOrigin:
        """Return the origin of a map after one more change."""
        return replace(self, derived=f"{self.derived}; {change}" if self.derived else change)


@dataclass(frozen=True, eq=False)
class ViewpointMap:
    """Ranked orientations of every free voxel.

    A point gets the scores of its voxel, which were computed at the centre; `interpolated` is smooth between centres.
    For points outside the grid or in voxels that are not free, queries of one point return None, and batches
    the direction -1. Points that are not finite raise a ValueError. See `scene_map.build_viewpoint_map`.

    Points, directions and poses are in the map's own frame and unit, as those of `WhereToLook`; the grid is in the world.

    Attributes:
        grid: V voxels of the world, metres, z up.
        row_of_voxel: (V,) int32, row of each free voxel in the arrays below, in ascending order; -1 for other voxels.
            In derived maps voxels may share rows.
        directions: (D, 3) float64 unit optical axes in the map's own frame.
        ranked: (L, D) uint16, ids of the directions at each of L free voxels, by falling score (in double precision),
            then by rising id.
        scores: (L, D) float32, by direction id.
        n_visible: (L, D) uint32, landmarks in view, by direction id.
        landmark_ids: (N,) int64, ascending.
        landmark_digests: (N, 2) uint64, digests of each landmark's position and of its attributes, for updates.
        origin: method, camera and so on.
        world_from_map: from the map's own frame to the world.
    """

    grid: VoxelGrid
    row_of_voxel: NDArray[np.int32]
    directions: Float
    ranked: NDArray[np.uint16]
    scores: NDArray[np.float32]
    n_visible: NDArray[np.uint32]
    landmark_ids: NDArray[np.int64]
    landmark_digests: NDArray[np.uint64]
    origin: MapOrigin
    world_from_map: Similarity = Similarity()

    def __post_init__(self) -> None:
        rows = self.row_of_voxel
        cells = (int(rows.max(initial=-1)) + 1, len(self.directions))
        shapes = {array.shape for array in (self.ranked, self.scores, self.n_visible)}
        if shapes != {cells} or rows.shape != (len(self.grid),):
            raise ValueError(
                f"{cells} rows and directions of {len(self.grid)} voxels do not fit {shapes}, {rows.shape}"
            )
        if not np.allclose(np.linalg.norm(self.directions, axis=1), 1, rtol=0, atol=1e-6) or not cells[1]:
            raise ValueError("directions must be unit vectors, and not none")
        in_order = self.origin.derived or np.array_equal(rows[rows >= 0], np.arange(cells[0]))
        if rows.min(initial=-1) < -1 or not in_order:
            raise ValueError("row_of_voxel must be -1 or count up with voxels, using every row once")

    @classmethod
    def load(cls, folder: str | Path, mmap: bool = False) -> ViewpointMap:
        """Read what `save` wrote; with `mmap` the files are mapped into memory (`map_file.read_map`).

        Raises MapFormatError if there is no map, or it is damaged or of another version.
        """
        grid, world_from_map, origin, arrays = read_map(folder, mmap)
        try:
            return cls(grid=grid, origin=MapOrigin(**origin), world_from_map=world_from_map, **arrays)
        except (TypeError, ValueError) as error:
            raise MapFormatError(f"damaged: {error}", path=Path(folder), fix=REBUILD) from error

    def save(self, folder: str | Path) -> None:
        """Write a folder that needs no Python to be read, see `wheretolook.planning.viewpoint_map.write_map`.

        Raises MapFormatError if the folder holds anything else than a map, or this map is derived.
        """
        origin = asdict(self.origin)
        if derived := origin.pop("derived"):
            fix = "Save the map it was derived from."
            raise MapFormatError("a derived map cannot be saved", path=Path(folder), value=derived, fix=fix)
        arrays = {name: getattr(self, name) for name in ARRAYS}
        write_map(folder, self.grid, self.world_from_map, origin, arrays)

    def in_frame(self, world_from_map: Similarity) -> ViewpointMap:
        """Return the same map for points and directions in another frame."""
        directions = self.directions @ self.world_from_map.rotation.T @ world_from_map.rotation
        return replace(self, directions=directions, world_from_map=world_from_map)

    @property
    def voxel_of_row(self) -> NDArray[np.int64]:
        """Ids (L,) of the free voxels, ascending; ValueError if voxels share rows in a derived map."""
        voxels = np.flatnonzero(self.row_of_voxel >= 0)
        if len(voxels) != len(self.scores):
            raise ValueError(f"voxels share rows in this map ({self.origin.derived}); ask the one it was derived from")
        return voxels

    @property
    def locations(self) -> Float:
        """Centres (L, 3) of the free voxels; raises as `voxel_of_row`."""
        return self.world_from_map.inverse.apply(self.grid.centers()[self.voxel_of_row])

    def row(self, point: Point) -> int:
        """Return the row of the free voxel that contains a point (3,); -1 if none does."""
        x, y, z = map(
            float, point if self._is_world else self.world_from_map.apply(point)
        )  # faster than NumPy's scalars
        x0, y0, z0, x1, y1, z1, dx, dy, dz, nx, ny, nz, rows = self._hash
        if x0 <= x <= x1 and y0 <= y <= y1 and z0 <= z <= z1:
            i = int((x - x0) / dx)
            j = int((y - y0) / dy)
            k = int((z - z0) / dz)
            # the grid is closed at its upper faces, as in `VoxelGrid.location_ids`
            i = i if i < nx else nx - 1
            j = j if j < ny else ny - 1
            k = k if k < nz else nz - 1
            return int(rows((i * ny + j) * nz + k))
        if not (isfinite(x) and isfinite(y) and isfinite(z)):
            raise ValueError(f"a point must be finite, got {(x, y, z)}")
        return -1

    def best(self, point: Point) -> ViewChoice | None:
        """Return the best orientation at a point (3,)."""
        row = self.row(point)
        return None if row < 0 else self._choice(row, self.ranked.item(row, 0))

    def best_n(self, point: Point, n: int) -> list[ViewChoice] | None:
        """Return the n best orientations at a point (3,), or all if there are fewer, the best first.

        Raises ValueError if n is less than 1.
        """
        if n < 1:
            raise ValueError(f"n must be at least 1, got {n}")
        row = self.row(point)
        return None if row < 0 else [self._choice(row, choice) for choice in self.ranked[row, :n].tolist()]

    def best_in_cone(self, point: Point, axis: ArrayLike, half_angle_deg: float) -> ViewChoice | None:
        """Return the best orientation whose optical axis is at most `half_angle_deg` from an axis (3,), or None.

        Raises ValueError if the axis is not finite or has no length.
        """
        inside = within(angles_to_axis_deg(self.directions, check_axis(axis)), half_angle_deg)
        return self._best_of(self.row(point), inside)

    def best_reachable(self, point: Point, current: ArrayLike, max_turn_deg: float) -> ViewChoice | None:
        """Return the best orientation that the camera reaches by a single rotation of at most `max_turn_deg`.

        The angle is that of the whole camera's rotation (`turns_deg`). `current` is the (3,) axis of a camera without
        roll, or the (3, 3) rotation of its pose. Returns None also if no direction of the lattice is in reach. Raises
        ValueError if `current` is not finite, an axis without length, or no rotation (such as a reflection).
        """
        turned = np.asarray(current, dtype=np.float64) @ self.world_from_map.rotation.T
        return self._best_of(self.row(point), within(turns_from_deg(turned, self._rotations), max_turn_deg))

    def best_looks(
        self, point: Point, n: int, max_turn_deg: float | None = None, *, scorer: Scorer, start: ArrayLike | None = None
    ) -> list[ViewChoice] | None:
        """Return the n orientations at a point (3,) with the highest joint score, in the order to look.

        The map's scores preselect orientations; their joint score is computed at the point itself by the `scorer` that
        the map was built with (`wheretolook.looks.selection.best_views`). The camera
        turns by at most `max_turn_deg` in all, from the axis `start` (3,) on if that is given. None where no voxel is
        free.

        Raises ConfigError for a number of looks or a limit that is none, or the scorer of another method; and
        PlanningError if no such looks can be reached.
        """
        if scorer.name != self.origin.scorer:
            fix = f"Give the scorer {self.origin.scorer!r}."
            raise ConfigError("the viewpoint map was built with another scorer", value=scorer.name, fix=fix)
        row = self.row(point)
        if row < 0:
            return None
        at = self.world_from_map.apply(point)
        turn = self.world_from_map.rotation.T
        first = None if start is None else np.asarray(start, dtype=np.float64) @ turn
        chosen = best_views(scorer, at, self.directions @ turn, self.scores[row], n, max_turn_deg, first)
        return [self._choice(row, look) for look in chosen.rows]

    def best_many(self, points: ArrayLike) -> Views:
        """Return the best view at each of points (N, 3), with `direction_id`, `score` and `n_visible`.

        Where no voxel is free, `direction_id` is -1, poses and scores are NaN, and `n_visible` is 0. Raises as `rows`.
        """
        rows = self.rows(points)
        ids, scores, n_visible = self._best_of_rows
        rotations = self._rotations @ self.world_from_map.rotation
        rotations = np.concatenate([rotations, np.full((1, 3, 3), np.nan)])[ids[rows]]  # the last for -1
        translations = -rotations @ np.asarray(points, dtype=np.float64)[..., None]
        return Views(
            np.concatenate([rotations, translations], axis=-1),
            method=self.origin.scorer,
            direction_id=ids[rows],
            score=scores[rows],
            n_visible=n_visible[rows],
        )

    def rows(self, points: ArrayLike) -> NDArray[np.int64]:
        """Return the rows (N,) of the free voxels that contain points (N, 3); -1 where none does.

        Raises ValueError for points of another shape, or not finite.
        """
        at = np.asarray(points, dtype=np.float64)
        if at.ndim != 2 or at.shape[1] != 3 or not np.isfinite(at).all():
            raise ValueError(f"points must be finite and of shape (N, 3), got shape {at.shape}")
        ids = self.grid.location_ids(self.world_from_map.apply(at))
        return np.where(ids >= 0, self.row_of_voxel[ids], -1).astype(np.int64)

    def interpolated(self, point: Point) -> Float | None:
        """Interpolate the scores (D,) float64 of all directions at a point (3,) between the centres of voxels.

        Neighbours that are not free or outside the grid are left out and the other weights normalized. None if the
        voxel that holds the point is not free.
        """
        if self.row(point) < 0:
            return None
        at = (self.world_from_map.apply(point) - self.grid.lower) / self.grid.voxel_m - 0.5
        low = np.floor(at).astype(np.int64)
        upper = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)
        corners = low + upper
        weights = np.prod(np.where(upper == 1, at - low, 1 - (at - low)), axis=1)
        exists = ((corners >= 0) & (corners < self.grid.shape)).all(axis=1)
        rows = self.row_of_voxel[np.ravel_multi_index(tuple(corners[exists].T), self.grid.shape)]
        weights = weights[exists][rows >= 0]
        # the voxel of the point is free and has at least an eighth of the weight
        return np.asarray(weights / weights.sum() @ self.scores[rows[rows >= 0]].astype(np.float64))

    def _best_of(self, row: int, allowed: NDArray[np.bool_]) -> ViewChoice | None:
        if row < 0 or not allowed.any():
            return None
        ranked = self.ranked[row]
        try:
            return self._choice(row, ranked.item(allowed[ranked].argmax()))
        except IndexError as error:
            raise _ranks_nothing(error) from error

    def _choice(self, row: int, direction: int) -> ViewChoice:
        try:
            axis = self._axes[direction]
            return ViewChoice(direction, axis, self.scores.item(row, direction), self.n_visible.item(row, direction))
        except IndexError as error:
            raise _ranks_nothing(error) from error

    @cached_property
    def _hash(self) -> tuple[Any, ...]:
        """Bounds, voxel size and shape of the grid as plain numbers, and the lookup of rows, for `row`."""
        grid = self.grid
        return (*map(float, (*grid.lower, *grid.upper, *grid.voxel_m)), *map(int, grid.shape), self.row_of_voxel.item)

    @cached_property
    def _axes(self) -> list[Float]:
        axes = self.directions.copy()
        axes.flags.writeable = False
        return list(axes)

    @cached_property
    def _rotations(self) -> Float:
        """Rotations (D, 3, 3) from the world to the camera."""
        return rotation_looking_along(self.directions @ self.world_from_map.rotation.T)

    @cached_property
    def _is_world(self) -> bool:
        frame = self.world_from_map
        return frame.scale == 1 and np.array_equal(frame.rotation, np.eye(3)) and not frame.translation.any()

    @cached_property
    def _best_of_rows(self) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.int64]]:
        """Id, score and landmarks in view of the best direction of each row; the last entry is for row -1."""
        best = self.ranked[:, 0].astype(np.int64)
        at = np.arange(len(best)), best
        try:
            scores = np.append(self.scores[at], np.float32(np.nan))
            return np.append(best, -1), scores, np.append(self.n_visible[at].astype(np.int64), 0)
        except IndexError as error:
            raise _ranks_nothing(error) from error


def _ranks_nothing(error: IndexError) -> MapFormatError:
    """Return the error for a damaged file that was mapped into memory without comparing its checksum."""
    return MapFormatError(f"ranked.npy is damaged: {error}", fix=REBUILD)
