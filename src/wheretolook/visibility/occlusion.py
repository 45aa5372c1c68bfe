"""Occlusion models: which landmarks are unoccluded, that is, have a free line of sight, from a location (paper, 3.2).

Occlusion depends on the location only, so one answer serves every direction a camera may look in from there."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import Float, as_points
from wheretolook.geometry.tsdf import TsdfVolume
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.utils.errors import MapError, SceneError, TableError, check_range
from wheretolook.utils.files import load_npz, save_npz
from wheretolook.utils.warp import start_warp, vec3_array

if TYPE_CHECKING:
    from wheretolook.space.free_space import FreeSpace
    from wheretolook.visibility.config import OcclusionConfig


class DevicePoints:
    """Landmarks (N, 3) m on a device along a Morton curve, so that threads side by side have landmarks side by side.

    `positions` (N, 3) are in the map's order, `order` (N,) are rows of the map in the order of the device's arrays, and
    `double` (N,) is a Warp array of vec3d.
    """

    def __init__(self, positions: ArrayLike, device: str = "cpu") -> None:
        self.positions = as_points(positions)
        self.device = start_warp(device)
        self.order = np.argsort(morton_codes(self.positions), kind="stable")
        self._single: dict[tuple[float, ...], Any] = {}
        self.double: Any = wp.array(self.positions[self.order], dtype=wp.vec3d, device=self.device)

    def __len__(self) -> int:
        return len(self.positions)

    def single(self, origin: Float) -> Any:
        """(N,) Warp array of vec3, from an origin (3,) m; made once for each."""
        key = tuple(origin.tolist())
        if key not in self._single:
            self._single[key] = vec3_array(self.positions[self.order] - origin, self.device)
        return self._single[key]

    @cached_property
    def rank(self) -> Any:
        """(N,) Warp array of int32: where the map's landmarks lie in the device's arrays, the inverse of `order`."""
        return wp.array(np.argsort(self.order).astype(np.int32), dtype=wp.int32, device=self.device)


def morton_codes(positions: Float) -> NDArray[np.int64]:
    """Place (N,) of points (N, 3) along a Morton curve through their bounding box; points not finite come first."""
    finite = np.isfinite(positions).all(1)
    codes = np.zeros(len(positions), dtype=np.int64)
    if not finite.any():
        return codes
    low = positions[finite].min(0) / 2  # halves: their difference is finite
    high = positions[finite].max(0) / 2
    share = (positions[finite] / 2 - low) / np.maximum(high - low, 1e-12)
    cells = (share * 1023).astype(np.int64)
    for bit in range(10):
        for axis in range(3):
            codes[finite] |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return codes


class OcclusionInputs(Protocol):
    """What an occlusion model can be made from by its class method `from_inputs`; a `Scene` provides it."""

    @property
    def occlusion_config(self) -> OcclusionConfig: ...
    @property
    def device(self) -> str: ...
    @property
    def mesh_space(self) -> FreeSpace: ...
    @property
    def tsdf_volume(self) -> TsdfVolume: ...


class OcclusionModel(ABC):
    """Decides which landmarks are unoccluded from a location.

    Callers ask for as many locations at once as their memory allows, so a model need not divide its work.
    """

    name: str = "custom"  # as in `OcclusionConfig`
    uses_all_cores: bool = False  # `unoccluded` occupies all cores of a CPU by itself

    @classmethod
    def from_inputs(cls, inputs: OcclusionInputs) -> OcclusionModel:
        """Make the model that `occlusion_config` of a scene describes."""
        raise NotImplementedError(f"{cls.__name__} is made by its caller only")

    @abstractmethod
    def unoccluded(self, locations: Float, points: Float) -> NDArray[np.bool_]:
        """Lines of sight from locations (L, 3) m to points (N, 3) m; (L, N), True where free."""

    def unoccluded_on_device(self, locations: Float, points: DevicePoints) -> Any | None:
        """`unoccluded` as a Warp array (L, N) of bool on the device of the points, in their order there.

        None stands for a mask that is True everywhere. By default computed on the host and uploaded.
        """
        mask = self.unoccluded(locations, points.positions)
        return wp.array(np.ascontiguousarray(mask[:, points.order]), dtype=wp.bool, device=points.device)

    def inside_geometry(self, locations: Float) -> NDArray[np.bool_]:
        """Whether locations (L, 3) m are inside geometry, where no camera can be; (L,). False if the model cannot decide."""
        return np.zeros(len(locations), dtype=bool)

    def check(self, locations: Float, points: Float) -> None:
        """Validate locations (L, 3) m and points (N, 3) m, before any long work.

        Raises a SceneError, which names the first, if a location is not finite or is inside geometry; a MapError if
        there are no landmarks.
        """
        if len(points) == 0:
            raise MapError("the map has no landmarks", value=0, fix="Map the scene with more or sharper images.")
        at = as_points(locations)
        infinite = at[~np.isfinite(at).all(axis=-1)]
        if len(infinite):
            raise SceneError("a location is not finite", value=infinite[0].tolist())
        inside = at[self.inside_geometry(at)]
        if len(inside):
            fix = "Give locations in free space, as `FreeSpace.is_free` finds them."
            raise SceneError("this location is inside geometry", value=inside[0].round(3).tolist(), fix=fix)


class NoOcclusion(OcclusionModel):
    """Sees through walls: every landmark has a free line of sight, as in the paper's released code."""

    name = "none"

    @classmethod
    def from_inputs(cls, inputs: OcclusionInputs) -> NoOcclusion:
        """Make the model, which needs nothing."""
        return cls()

    def unoccluded(self, locations: Float, points: Float) -> NDArray[np.bool_]:
        """All True, (L, N)."""
        return np.ones((len(locations), len(points)), dtype=bool)

    def unoccluded_on_device(self, locations: Float, points: DevicePoints) -> None:
        """None: every line of sight is free."""


class MeshOcclusion(OcclusionModel):
    """Exact occlusion by the scene's mesh: one ray for each location and landmark.

    A surface `margin_m` in front of a landmark counts as the surface that it is on; ConfigError if that is negative or not finite.
    `two_sided` says whether the backs of triangles are surfaces too, which `FreeSpace.two_sided` finds out. If not, a
    location from which mostly backs are visible is inside geometry.
    """

    name = "mesh"

    def __init__(self, raycaster: MeshRaycaster, margin_m: float = 0.05, two_sided: bool = True) -> None:
        check_range("margin_m", margin_m, 0)
        self.raycaster = raycaster
        self.margin_m = margin_m
        self.two_sided = two_sided

    @classmethod
    def from_inputs(cls, inputs: OcclusionInputs) -> MeshOcclusion:
        """Make the model from the mesh."""
        space = inputs.mesh_space
        return cls(space.raycaster, inputs.occlusion_config.margin_m, space.two_sided)

    def unoccluded(self, locations: Float, points: Float) -> NDArray[np.bool_]:
        """(L, N), True where no triangle stands between location and landmark."""
        return ~self.raycaster.occluded(locations, points, margin_m=self.margin_m)

    def unoccluded_on_device(self, locations: Float, points: DevicePoints) -> Any | None:
        """As `unoccluded`, on the raycaster's device."""
        if points.device != self.raycaster.device:
            return super().unoccluded_on_device(locations, points)
        return self.raycaster.unoccluded_on_device(locations, points.single(self.raycaster.origin), self.margin_m)

    def inside_geometry(self, locations: Float) -> NDArray[np.bool_]:
        """Whether locations (L, 3) m are on a surface, within 1 mm, or, in a one-sided mesh, surrounded mostly by backs; (L,)."""
        at = as_points(locations)
        inside = self.raycaster.distance_to_surface(at, 1e-3) <= 1e-3
        if not self.two_sided:
            _, backs = self._sides_seen(at)
            inside |= backs.mean(1) > 0.5
        return np.asarray(inside)

    def _sides_seen(self, locations: Float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which of 32 rays around each location (L, 3) m meet a front first, and which a back; each (L, 32)."""
        hits = self.raycaster.cast(np.repeat(locations, 32, axis=0), np.tile(fibonacci_sphere(32), (len(locations), 1)))
        hit = np.isfinite(hits.distance_m)
        return (hit & hits.front).reshape(-1, 32), (hit & ~hits.front).reshape(-1, 32)


class StoredOcclusion(OcclusionModel):
    """Occlusion computed once for the locations of a dataset and stored, so that the mesh is no longer needed.

    Of L locations and N landmarks in the map's order, `packed` (L, ceil(N / 8)) uint8 is the mask as `numpy.packbits`
    packs it: a bit is set where the line of sight is free. `model` names the occlusion model it was computed with.
    """

    def __init__(self, locations: ArrayLike, packed: NDArray[np.uint8], n_landmarks: int, model: str = "mesh") -> None:
        self.locations = np.asarray(locations, dtype=np.float64)
        self.packed = packed
        self.n_landmarks = n_landmarks
        self.name = model
        if packed.shape != (len(self.locations), (n_landmarks + 7) // 8):
            raise ValueError(f"{packed.shape} bytes for {len(self.locations)} locations and {n_landmarks} landmarks")
        self._tree = cKDTree(self.locations)

    @classmethod
    def from_mask(cls, locations: ArrayLike, mask: NDArray[np.bool_], model: str = "mesh") -> StoredOcclusion:
        """From a dense mask (L, N), True where the line of sight is free."""
        return cls(locations, np.packbits(mask, axis=1), mask.shape[1], model)

    @property
    def mask(self) -> NDArray[np.bool_]:
        """The whole mask, (L, N)."""
        return self._unpack(slice(None))

    def unoccluded(self, locations: Float, points: Float) -> NDArray[np.bool_]:
        """Rows (L, N) of the stored mask, of locations to 0.1 mm.

        Raises a TableError if a location was not stored, or the mask is of another number of landmarks.
        """
        if len(points) != self.n_landmarks:
            problem = f"stored occlusion is of {self.n_landmarks} landmarks, the map has {len(points)}"
            raise TableError(problem, fix="Run the sample stage again.")
        distance, row = self._tree.query(locations, distance_upper_bound=1e-4)
        unknown = np.asarray(locations)[~np.isfinite(distance)]
        if len(unknown):
            fix = "Use a mesh for free locations, or sample this location first."
            raise TableError("no stored occlusion for this location", value=unknown[0].tolist(), fix=fix)
        return self._unpack(row)

    def _unpack(self, rows: NDArray[np.integer[Any]] | slice) -> NDArray[np.bool_]:
        return np.unpackbits(self.packed[rows], axis=1, count=self.n_landmarks).view(bool)

    def save(self, path: Path) -> None:
        """Write locations and the bit-packed mask as a compressed NPZ, atomically."""
        about = {"n_landmarks": np.array(self.n_landmarks), "model": np.array(self.name)}
        save_npz(path, {"locations": self.locations, "mask": self.packed, **about}, compress=True)

    @classmethod
    def load(cls, path: Path) -> StoredOcclusion:
        """Read what `save` wrote. Raises TableError if the file is missing or damaged."""
        try:
            data = load_npz(path)
            return cls(data["locations"], data["mask"], int(data["n_landmarks"]), str(data.get("model", "mesh")))
        except (ValueError, KeyError, TypeError) as error:
            fix = "Run the sample stage again."
            raise TableError(f"cannot read stored occlusion: {error}", path=path, fix=fix) from error


class CachedOcclusion(OcclusionModel):
    """Caches the masks of another model, one bit for each line of sight.

    Hidden-point removal takes a tenth of a second for a location, and is evaluated several times: for the scores of all
    directions, for those of the best views, and for their visible landmarks. Locations are rounded to 0.01 mm. When `max_bytes` are exceeded the cache is
    cleared. Not safe for several threads with the same location.
    """

    def __init__(self, model: OcclusionModel, max_bytes: int = 1 << 30) -> None:
        self.model = model
        self.max_bytes = max_bytes
        self.name = model.name
        self.uses_all_cores = model.uses_all_cores
        self._known: dict[tuple[float, ...], NDArray[np.uint8]] = {}

    def unoccluded(self, locations: Float, points: Float) -> NDArray[np.bool_]:
        """Mask (L, N) of the model, from the cache where possible."""
        at = as_points(locations)
        of_points = len(points), float(np.sum(points))  # differ between sets of landmarks
        keys = [(*of_points, *key) for key in (np.round(at, 5) + 0.0).tolist()]
        new = [row for row, key in enumerate(keys) if key not in self._known]
        mask = np.empty((len(at), len(points)), dtype=bool)
        if new:
            mask[new] = self.model.unoccluded(at[new], points)
        for row, key in enumerate(keys):
            if key in self._known:
                mask[row] = np.unpackbits(self._known[key], count=len(points)).view(bool)
        for row, packed in zip(new, np.packbits(mask[new], axis=1), strict=True):
            if (len(self._known) + 1) * packed.nbytes > self.max_bytes:
                self._known = {}
            self._known[keys[row]] = packed
        return mask

    def unoccluded_on_device(self, locations: Float, points: DevicePoints) -> Any | None:
        """Mask of the model where that runs on a GPU, uncached; else by `unoccluded`."""
        if points.device != "cpu" and not self.uses_all_cores:
            return self.model.unoccluded_on_device(locations, points)
        return super().unoccluded_on_device(locations, points)

    def inside_geometry(self, locations: Float) -> NDArray[np.bool_]:
        """Result of the model, (L,)."""
        return self.model.inside_geometry(locations)

    def check(self, locations: Float, points: Float) -> None:
        """Validate by the model."""
        self.model.check(locations, points)


class TsdfOcclusion(MeshOcclusion):
    """Occlusion by the surface of a TSDF: one ray for each location and landmark.

    Space that no depth image saw occludes nothing. The volume is no longer needed afterwards. A surface up to
    `margin_m` in front of a landmark counts as the surface that it is on; keep the margin above two voxels. Raises ConfigError if it
    is negative, or there is no such device; SceneError if the depth images show no surface.
    """

    name = "tsdf"

    def __init__(self, volume: TsdfVolume, margin_m: float = 0.05, device: str = "cpu") -> None:
        super().__init__(MeshRaycaster(volume.surface(), device), margin_m)
        self._too_close_m = volume.voxel_size_m / 2

    @classmethod
    def from_inputs(cls, inputs: OcclusionInputs) -> TsdfOcclusion:
        """Make the model from the volume that the depth images fuse to."""
        return cls(inputs.tsdf_volume, inputs.occlusion_config.margin_m, inputs.device)

    def inside_geometry(self, locations: Float) -> NDArray[np.bool_]:
        """Whether locations (L, 3) m are within half a voxel of a surface, or behind surfaces; (L,).

        A location is behind surfaces if more of the 32 rays around it meet a back than a front: it is in furniture or a
        wall, or outside of the observed space. If no ray meets a surface, the location counts as free.
        """
        at = as_points(locations)
        fronts, backs = self._sides_seen(at)
        behind = backs.sum(1) > fronts.sum(1)
        close = self.raycaster.distance_to_surface(at, self._too_close_m) <= self._too_close_m
        return np.asarray(behind | close)
