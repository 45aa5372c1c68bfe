"""Landmarks of a map and what is known about each: the input of visibility, features and scorers."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import DTypeLike, NDArray
from tqdm.auto import tqdm

from wheretolook.features.descriptors import DescriptorKind, unit_descriptors
from wheretolook.features.registry import all_kinds
from wheretolook.features.sift import SIFT
from wheretolook.geometry.local_origin import local_origin
from wheretolook.mapping.attribute_names import MAP_ATTRIBUTES
from wheretolook.mapping.colmap_model import ModelArrays, model_arrays, read_model
from wheretolook.mapping.feature_files import read_descriptors
from wheretolook.utils.errors import MapError, MapWarning
from wheretolook.utils.npz_files import load_npz, save_npz

if TYPE_CHECKING:
    import pycolmap

_BLOCK = 4096  # landmarks whose tracks are gathered at a time
_SILENT_S = 2.0  # progress is shown of what takes longer
_WHOLE = ("ids", "track_length", "descriptors")  # arrays of whole numbers; all others are of floats
_TILE = 512  # descriptors along a side of a product that stays in the cache


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Landmarks, one a row, sorted by id."""

    ids: NDArray[np.int64]  # (N,) COLMAP's point3D_id
    points: NDArray[np.float64]  # (N, 3) world, metres
    track_length: NDArray[np.int32]  # (N,) number of observations
    reprojection_error_px: NDArray[np.float32]  # (N,) mean over the observations
    triangulation_angle_deg: NDArray[np.float32]  # (N,) largest angle between two rays of the track
    mapping_direction: NDArray[np.float32]  # (N, 3) unit mean direction from the mapping cameras to the landmark, world
    mapping_direction_spread: NDArray[np.float32]  # (N,) 1 - |mean of the unit directions|: 0 if all are the same
    mapping_distance_m: NDArray[np.float32]  # (N,) mean distance of the mapping cameras
    mapping_distance_spread: NDArray[np.float32]  # (N,) standard deviation of these over their mean; NaN in old files
    # (N, D) mean over the track of the unit descriptors, as their kind is stored: of SIFT (N, 128) uint8, times 512 as
    # COLMAP stores them; None without a database
    descriptors: NDArray[Any] | None
    # (N,) cosine between the descriptor and the nearest one of another landmark; NaN without descriptors or others
    ambiguity: NDArray[np.float32]
    # (N,) mean focal length of the mapping cameras, of the logarithms; None in files from before it was told
    mapping_focal_px: NDArray[np.float32] | None = None
    described_by: str | None = None  # the kind of learned descriptors; None for SIFT, or where there were none

    @property
    def features(self) -> str:
        """Name of the kind of descriptors that the landmarks have, or had: see `wheretolook.features.registry`.

        "" if there were none.
        """
        if self.described_by is not None:
            return self.described_by
        return SIFT.name if self.descriptors is not None or np.isfinite(self.ambiguity).any() else ""

    def __len__(self) -> int:
        return len(self.ids)

    def attributes(self) -> NDArray[np.float32]:
        """`MAP_ATTRIBUTES` of each landmark, (N, len(MAP_ATTRIBUTES)) float32."""
        focal_px = self.mapping_focal_px
        distance = np.log(np.maximum(self.mapping_distance_m, 1e-3))
        values = {
            "track_length": np.log(np.maximum(self.track_length, 1)),
            "reprojection_error": self.reprojection_error_px,
            "triangulation_angle": np.log(np.maximum(self.triangulation_angle_deg, 0.01)),
            "direction_spread": self.mapping_direction_spread,
            "ambiguity": self.ambiguity,
            "mapped_distance": distance,
            "distance_spread": self.mapping_distance_spread,
            "mapped_pixel_size": distance - np.log(np.full(len(self), np.nan) if focal_px is None else focal_px),
        }
        return np.stack([values[name] for name in MAP_ATTRIBUTES], axis=1).astype(np.float32)

    def save(self, path: str | Path, compact: bool = False) -> None:
        """Write an NPZ file, atomically. The same landmarks give the same bytes.

        `compact` leaves out the descriptors, writes points in single (far from the origin in double) and attributes in
        half precision, and compresses: about 28 bytes a landmark. Such landmarks serve visibility, features and
        scorers, but not localization.
        """
        arrays = (f.name for f in fields(self) if f.name != "described_by")
        values = {name: getattr(self, name) for name in arrays if getattr(self, name) is not None}
        if compact:
            values.pop("descriptors", None)
            far = local_origin(self.points).any()
            values = _floats(values, points=np.float64 if far else np.float32, others=np.float16)
        if self.described_by is not None:
            values["described_by"] = np.array(self.described_by)
        save_npz(Path(path), values, compress=compact)

    @classmethod
    def load(cls, path: str | Path) -> Landmarks:
        """Read what `save` wrote, compact or not. MapError if the file is missing, truncated, or not of landmarks."""
        path = Path(path)
        fix = "Run the map stage again."
        if not path.is_file():
            raise MapError("there is no file of landmarks", path=path, fix=fix)
        try:
            values = load_npz(path)
        except ValueError as error:
            raise MapError(str(error), path=path, fix=fix) from error
        described_by = values.pop("described_by", None)
        if described_by is not None and str(described_by) not in all_kinds():
            fix = f"There are {', '.join(all_kinds())}: update wheretolook, or map again."
            raise MapError("landmarks of unknown features", path=path, value=str(described_by), fix=fix)
        kind = SIFT if described_by is None else all_kinds()[str(described_by)]
        names = {f.name for f in fields(cls)} - {"described_by"}
        if set(values) and "mapping_distance_spread" not in values and "mapping_distance_m" in values:
            values["mapping_distance_spread"] = np.full(values["mapping_distance_m"].shape[:1], np.nan, np.float32)
        if set(values) | {"descriptors", "mapping_focal_px"} != names:
            raise MapError("not a file of landmarks", path=path, value=sorted(values), fix=fix)
        for name, value in values.items():
            whole = name in _WHOLE and (name != "descriptors" or kind.in_bytes)
            if value.ndim == 0 or value.dtype.kind not in ("iu" if whole else "f"):
                problem = f"the array {name} is not one of {'whole ' if whole else ''}numbers, one a landmark"
                raise MapError(problem, path=path, value=f"{value.dtype} {value.shape}", fix=fix)
        if len({len(v) for v in values.values()}) != 1 or values["points"].shape[1:] != (3,):
            raise MapError("the arrays disagree on the number of landmarks", path=path, fix=fix)
        sides = {"points": (3,), "mapping_direction": (3,)}
        for name, value in values.items():
            if value.shape[1:] != sides.get(name, ()) and (name != "descriptors" or value.ndim != 2):
                raise MapError(f"the array {name} has another shape", path=path, value=value.shape, fix=fix)
        if not np.isfinite(values["points"]).all():
            raise MapError("some landmarks are not at finite places", path=path, fix=fix)
        found = values.get("descriptors")
        if found is not None and kind is not SIFT and found.shape[1] != kind.dimension:
            problem = f"descriptors of {kind.name} have {kind.dimension} numbers"
            raise MapError(problem, path=path, value=found.shape[1], fix=fix)
        arrays: dict[str, Any] = {
            "descriptors": None,
            "mapping_focal_px": None,
            **_floats(values, points=np.float64, others=np.float32),
            "described_by": None if described_by is None else kind.name,
        }
        if found is not None:
            arrays["descriptors"] = found  # halves stay halves
        return cls(**arrays)


def features_of(path: Path) -> str:
    """Name of the kind of descriptors that a file of landmarks was made from, read alone; SIFT's if it says nothing.

    "sift" also where there were no descriptors at all. Raises MapError if the file is missing or damaged.
    """
    try:
        said = load_npz(path, ("described_by",)).get("described_by")
    except ValueError as error:
        raise MapError(str(error), path=path, fix="Run the map stage again.") from error
    return SIFT.name if said is None else str(said)


def _floats(values: dict[str, NDArray[Any]], points: DTypeLike, others: DTypeLike) -> dict[str, NDArray[Any]]:
    """The same arrays, with the points and all other arrays of floats cast to the types given."""
    floats = {name: points if name == "points" else others for name, value in values.items() if value.dtype.kind == "f"}
    return {name: value.astype(floats.get(name, value.dtype), copy=False) for name, value in values.items()}


def load_colmap_landmarks(
    model_dir: str | Path,
    database: str | Path | None = None,
    max_reprojection_error_px: float | None = None,
    device: str = "cpu",
    reconstruction: pycolmap.Reconstruction | None = None,
    progress: bool = True,
) -> Landmarks:
    """Landmarks of a COLMAP model (binary or text) in metres, with their attributes. Its images may have many cameras.

    The features the model was built from (`read_descriptors`) give descriptors and ambiguity, by a search of the
    nearest descriptors on a torch device. What the model's own mapper kept is kept, unless a largest mean reprojection
    error is given; a `MapWarning` counts the points that are left out. `reconstruction` is the model, if it has been
    read already.

    Raises MapError if the folder, a file or the database is missing, corrupt or does not match, or no landmark is left.
    """
    reconstruction = reconstruction or read_model(model_dir)
    if reconstruction.num_points3D() == 0:
        fix = "Triangulate it, or map with more overlap or texture."
        raise MapError("the model has no points", path=model_dir, fix=fix)
    model = model_arrays(reconstruction)
    observed = np.diff(model.observation_start) > 0
    if not observed.any():
        raise MapError("no point of the model has a track", path=model_dir, fix="Triangulate the model from keypoints.")
    worst_px = np.inf if max_reprojection_error_px is None else max_reprojection_error_px
    keep = np.flatnonzero(observed & (model.errors_px <= worst_px))
    if len(keep) == 0:
        problem = f"all {observed.sum()} points have more than {max_reprojection_error_px} px mean reprojection error"
        least = f"least {model.errors_px[observed].min():.2f} px"
        fix = "Raise max_reprojection_error_px, or check the intrinsics and poses of the model."
        raise MapError(problem, path=model_dir, value=least, fix=fix)
    if not np.isfinite(model.points[keep]).all():
        raise MapError("some points are not finite", path=model_dir, fix="Triangulate the model again.")
    _tell_left_out(observed, len(keep), worst_px, model_dir)
    model = _select_points(model, keep)
    described_by = None
    descriptors = None
    ambiguity = np.full(len(keep), np.nan, dtype=np.float32)
    observations = None if database is None else read_descriptors(database, model_dir, reconstruction, model)
    if observations is not None:
        kind, of_observations = observations
        descriptors = _mean_descriptors(model, of_observations, kind)
        ambiguity = nearest_other_cosine(descriptors, device, progress)
        described_by = None if kind is SIFT else kind.name
    track_length = np.diff(model.observation_start).astype(np.int32)
    errors_px = model.errors_px.astype(np.float32)
    attributes: Any = {**_viewing_geometry(model), "descriptors": descriptors, "ambiguity": ambiguity}
    attributes["described_by"] = described_by
    return Landmarks(model.point_ids, model.points, track_length, errors_px, **attributes)


def _tell_left_out(observed: NDArray[np.bool_], n_kept: int, worst_px: float, model_dir: str | Path) -> None:
    n_unobserved = int((~observed).sum())
    n_inaccurate = int(observed.sum()) - n_kept
    if not n_unobserved + n_inaccurate:
        return
    reasons = [f"{n_inaccurate:,} with a mean reprojection error of more than {worst_px:g} px"] if n_inaccurate else []
    reasons += [f"{n_unobserved:,} that no image observes"] if n_unobserved else []
    text = f"{model_dir}: {n_kept:,} of {len(observed):,} points are landmarks; left out: {', '.join(reasons)}"
    warnings.warn(text, MapWarning, stacklevel=3)


def nearest_other_cosine(descriptors: NDArray[Any], device: str = "cpu", progress: bool = True) -> NDArray[np.float32]:
    """Cosine between each stored descriptor (N, D) and the nearest one of another row. Returns (N,), NaN if N is 1.

    Sums of products of bytes are exact in float32, so that of SIFT the result does not depend on the machine.
    """
    import torch  # takes seconds to load, and most maps are read without it

    n = len(descriptors)
    threads = torch.get_num_threads()
    values = torch.as_tensor(descriptors, dtype=torch.float32, device=device)
    lengths = torch.as_tensor(np.linalg.norm(descriptors.astype(np.float64), axis=1), device=device)
    inverse = 1 / torch.where(lengths > 0, lengths, 1).float()
    best = torch.full((n,), -torch.inf, device=device)
    torch.set_num_threads(1)  # products are small: several threads would mostly wait for one another
    try:
        tiles = tqdm(range(0, n, _TILE), "landmarks: ambiguity", delay=_SILENT_S, unit="block", disable=not progress)
        for i in tiles:
            for j in range(i, n, _TILE):  # each pair of tiles once: its product serves rows and columns
                rows = slice(i, min(i + _TILE, n))
                columns = slice(j, min(j + _TILE, n))
                cosine = values[rows] @ values[columns].T
                cosine *= inverse[rows, None] * inverse[columns]
                if i == j:
                    cosine.fill_diagonal_(-torch.inf)
                best[rows] = torch.maximum(best[rows], cosine.amax(1))
                best[columns] = torch.maximum(best[columns], cosine.amax(0))
    finally:
        torch.set_num_threads(threads)
    return torch.where(best.isinf(), torch.nan, best).cpu().numpy()


def _select_points(model: ModelArrays, keep: NDArray[np.int64]) -> ModelArrays:
    lengths = np.diff(model.observation_start)[keep]
    start = np.concatenate([[0], np.cumsum(lengths)])
    rows = np.repeat(model.observation_start[keep] - start[:-1], lengths) + np.arange(start[-1])
    points = {name: getattr(model, name)[keep] for name in ("point_ids", "points", "errors_px")}
    observations = {name: getattr(model, name)[rows] for name in ("observation_image", "observation_keypoint")}
    return replace(model, **points, **observations, observation_start=start)


def _viewing_geometry(model: ModelArrays) -> dict[str, NDArray[np.float32]]:
    start = model.observation_start
    lengths = np.diff(model.observation_start)
    rays = np.repeat(model.points, lengths, axis=0) - model.image_centers[model.observation_image]
    distance = np.linalg.norm(rays, axis=1)
    rays /= np.maximum(distance, 1e-12)[:, None]
    mean = np.add.reduceat(rays, start[:-1]) / lengths[:, None]
    length = np.linalg.norm(mean, axis=1)
    angle = np.zeros(len(lengths))
    for n in np.unique(lengths):  # tracks of one length at a time, so that all pairs of rays are one product
        members = np.flatnonzero(lengths == n)
        for block in np.array_split(members, -(-len(members) * int(n) ** 2 // 4_000_000)):
            track = rays[start[block][:, None] + np.arange(n)]
            angle[block] = np.degrees(np.arccos(np.clip((track @ track.swapaxes(1, 2)).min((1, 2)), -1, 1)))
    mean_distance = np.add.reduceat(distance, start[:-1]) / lengths
    variance = np.add.reduceat((distance - np.repeat(mean_distance, lengths)) ** 2, start[:-1]) / lengths
    log_focal = np.add.reduceat(np.log(model.image_focal_px[model.observation_image]), start[:-1]) / lengths
    return {
        "mapping_focal_px": np.exp(log_focal).astype(np.float32),
        "triangulation_angle_deg": angle.astype(np.float32),
        "mapping_direction": (mean / np.maximum(length, 1e-12)[:, None]).astype(np.float32),
        "mapping_direction_spread": np.clip(1 - length, 0, 1).astype(np.float32),
        "mapping_distance_m": mean_distance.astype(np.float32),
        "mapping_distance_spread": (np.sqrt(variance) / np.maximum(mean_distance, 1e-12)).astype(np.float32),
    }


def _mean_descriptors(model: ModelArrays, observations: NDArray[Any], kind: DescriptorKind) -> NDArray[Any]:
    start = model.observation_start
    mean = np.empty((len(start) - 1, observations.shape[1]), dtype=observations.dtype)
    for i in range(0, len(mean), _BLOCK):
        last = min(i + _BLOCK, len(mean))
        track = unit_descriptors(observations[start[i] : start[last]])
        mean[i:last] = kind.store(unit_descriptors(np.add.reduceat(track, start[i:last] - start[i])))
    return mean
