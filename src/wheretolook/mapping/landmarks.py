"""Names of the attributes of a map's landmarks. Not in `landmarks.py`, so that options are read without PyTorch."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray
from tqdm.auto import tqdm

from wheretolook.features.extractor import KINDS, SIFT, DescriptorKind, unit_descriptors
from wheretolook.geometry.poses import Float
from wheretolook.geometry.similarity import local_origin
from wheretolook.mapping.colmap_model import ModelArrays, model_arrays, read_model, select_points
from wheretolook.mapping.feature_files import read_descriptors
from wheretolook.utils.errors import MapError, MapWarning
from wheretolook.utils.files import load_npz, save_npz

MAP_ATTRIBUTES = (
    "track_length",  # logarithm of the number of observations
    "reprojection_error",  # mean error in pixels
    "triangulation_angle",  # logarithm of the largest angle between two rays, in degrees
    "direction_spread",  # 1 - |mean mapping direction|
    "ambiguity",  # cosine between the landmark's descriptor and the nearest one of another landmark
    "mapped_distance",  # logarithm of the mean mapping distance, in metres
    "distance_spread",  # standard deviation of the mapping distances over their mean
    "mapped_pixel_size",  # logarithm of the mean mapping distance over the mapping cameras' focal length in pixels
)
"""Attributes of a landmark that scorers use; NaN where a value is unknown."""


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Landmarks of a map, one per row, sorted by id."""

    ids: NDArray[np.int64]  # (N,) COLMAP's point3D_id
    points: NDArray[np.float64]  # (N, 3) world, metres
    track_length: NDArray[np.int32]  # (N,) number of observations
    reprojection_error_px: NDArray[np.float32]  # (N,) mean over the observations
    triangulation_angle_deg: NDArray[np.float32]  # (N,) largest angle between two rays of the track
    mapping_direction: NDArray[np.float32]  # (N, 3) unit mean direction from the mapping cameras to the landmark, world
    mapping_direction_spread: NDArray[np.float32]  # (N,) 1 - |mean of the unit directions|: 0 if all are the same
    mapping_distance_m: NDArray[np.float32]  # (N,) mean distance of the mapping cameras
    mapping_distance_spread: NDArray[np.float32]  # (N,) standard deviation of these over their mean
    # (N, D) mean over the track of the unit descriptors, as their kind is stored: of SIFT (N, 128) uint8, times 512 as
    # COLMAP stores them; None without a database
    descriptors: NDArray[Any] | None
    # (N,) cosine between the descriptor and the nearest one of another landmark; NaN without descriptors or others
    ambiguity: NDArray[np.float32]
    # (N,) geometric mean of the mapping cameras' focal lengths; None in the released maps, which have one camera
    mapping_focal_px: NDArray[np.float32] | None = None
    described_by: str | None = None  # the kind of learned descriptors; None for SIFT, or without descriptors

    @property
    def features(self) -> str:
        """Name in `wheretolook.features.extractor` of the descriptors that the map was built with; "" without any."""
        if self.described_by is not None:
            return self.described_by
        return SIFT.name if self.descriptors is not None or np.isfinite(self.ambiguity).any() else ""

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def keypoint_noise_px(self) -> float | None:
        """Standard deviation of a coordinate of the mapping images' keypoints, in pixels; None if it is unknown.

        The median over landmarks of at least three observations of their mean reprojection error over that of normal
        noise, sqrt(pi / 2). A track of n keypoints has 2 n coordinates, and determines 3.
        """
        errors = self.reprojection_error_px
        known = (self.track_length >= 3) & (errors > 0) & (errors < np.inf)  # 0, NaN and infinity are unknown
        n = self.track_length[known].astype(np.float64)
        noise = errors[known] * np.sqrt(4 * n / (np.pi * (2 * n - 3)))
        return float(np.median(noise)) if len(n) else None

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

        `compact` omits the descriptors, writes points in single (far from the origin in double) and attributes in
        half precision, and compresses: about 28 bytes a landmark. Such landmarks suffice for visibility, features and
        scorers, but not for localization.
        """
        values = {name: value for name, value in vars(self).items() if value is not None and name != "described_by"}
        if compact:
            values.pop("descriptors", None)
            far = local_origin(self.points).any()
            values = _cast_floats(values, np.float64 if far else np.float32, np.float16)
        if self.described_by is not None:
            values["described_by"] = np.array(self.described_by)
        save_npz(Path(path), values, compress=compact)

    @classmethod
    def load(cls, path: str | Path) -> Landmarks:
        """Read what `save` wrote, compact or not. Raises MapError if the file is missing or not valid."""
        try:
            values = load_npz(Path(path))
            descriptors = values.pop("descriptors", None)
            kind = KINDS[str(values.pop("described_by", SIFT.name))]
            values = _cast_floats(values, np.float64, np.float32)
            return cls(**values, descriptors=descriptors, described_by=None if kind is SIFT else kind.name)
        except (ValueError, KeyError, TypeError) as error:
            raise MapError(f"not a file of landmarks: {error}", path=path, fix="Run the map stage again.") from error


def read_feature_name(path: Path) -> str:
    """Read the name of the descriptors that a file of landmarks was made with; SIFT's if none is recorded.

    Raises MapError if the file is missing or damaged.
    """
    try:
        return str(load_npz(path, ("described_by",)).get("described_by", SIFT.name))
    except ValueError as error:
        raise MapError(str(error), path=path, fix="Run the map stage again.") from error


def _cast_floats(values: dict[str, NDArray[Any]], points: DTypeLike, others: DTypeLike) -> dict[str, NDArray[Any]]:
    """Cast the points and all other arrays of floats to the given types; arrays of integers stay as they are."""
    types = {name: points if name == "points" else others for name, value in values.items() if value.dtype.kind == "f"}
    return {name: value.astype(types.get(name, value.dtype), copy=False) for name, value in values.items()}


def load_colmap_landmarks(
    model_dir: str | Path,
    database: str | Path | None = None,
    max_reprojection_error_px: float | None = None,
    device: str = "cpu",
    reconstruction: Any = None,
    progress: bool = True,
    arrays: ModelArrays | None = None,
    ambiguity: bool = True,
) -> Landmarks:
    """Compute the landmarks of a COLMAP model (binary or text) in metres, with their attributes.

    The features that the model was built from (`read_descriptors`) give descriptors and ambiguity, by a search of the
    nearest descriptors on a torch device. All points of the model are landmarks, unless a largest mean reprojection
    error is given; a `MapWarning` counts the points that are left out. `reconstruction` is the model, if it was read
    before, and `arrays` what is taken of it, if that is transformed; its images may have many cameras. `ambiguity`
    False leaves the ambiguity out, which takes minutes for a large map.

    Raises MapError if the folder, a file or the database is missing, corrupt or does not match, or no landmark remains.
    """
    reconstruction = reconstruction or read_model(model_dir)
    model = arrays or model_arrays(reconstruction)
    observed = np.diff(model.observation_start) > 0
    worst_px = np.inf if max_reprojection_error_px is None else max_reprojection_error_px
    keep = observed & (model.errors_px <= worst_px)
    if not keep.any():
        value = f"{len(observed)} points, {observed.sum()} with a track"
        if observed.any():
            problem = f"the model has no points with a track and a reprojection error of at most {worst_px:g} px"
            fix = "Raise max_reprojection_error_px, or check the model's intrinsics and poses."
        else:
            problem = "the model has no points with a track: which images observe which points is unknown"
            fix = f"`wheretolook map --model {model_dir} --images PHOTOGRAPHS` triangulates it."
        raise MapError(problem, path=model_dir, value=value, fix=fix)
    if not keep.all():
        text = (
            f"{model_dir}: {keep.sum():,} of {len(keep):,} points are landmarks; {(~observed).sum():,} that no image "
        )
        text += f"observes are omitted, and {(observed & ~keep).sum():,} with a mean error of more than {worst_px:g} px"
        warnings.warn(text, MapWarning, stacklevel=2)
    model = select_points(model, keep)
    kind = SIFT
    descriptors = None
    cosine = np.full(len(model.points), np.nan, dtype=np.float32)
    observations = None if database is None else read_descriptors(database, reconstruction, model)
    if observations is not None:
        kind, of_observations = observations
        descriptors = _mean_descriptors(model, of_observations, kind)
        if ambiguity:
            cosine = max_cosine_to_other(descriptors, device, progress)
    return Landmarks(
        ids=model.point_ids,
        points=model.points,
        track_length=np.diff(model.observation_start).astype(np.int32),
        reprojection_error_px=model.errors_px.astype(np.float32),
        **_viewing_geometry(model),
        descriptors=descriptors,
        ambiguity=cosine,
        described_by=None if kind is SIFT else kind.name,
    )


def landmarks_of(landmarks: Landmarks, arrays: ModelArrays) -> Landmarks:
    """Return the landmarks that are points of a model (P, all of them landmarks), with the attributes of its tracks.

    Their errors, ambiguities and descriptors stay as they are.
    """
    rows = np.searchsorted(landmarks.ids, arrays.point_ids)
    values: dict[str, Any] = {
        name: value[rows] if isinstance(value, np.ndarray) else value for name, value in vars(landmarks).items()
    }
    values["track_length"] = np.diff(arrays.observation_start).astype(np.int32)
    return Landmarks(**{**values, **_viewing_geometry(arrays)})


def max_cosine_to_other(descriptors: NDArray[Any], device: str = "cpu", progress: bool = True) -> NDArray[np.float32]:
    """Compute the cosine (N,) between each stored descriptor (N, D) and the nearest other one; NaN if N is 1.

    Dot products of uint8 descriptors are exact in float32, so the result for SIFT is the same on every machine.
    """
    import torch  # takes seconds to load, and most maps are read without it

    from wheretolook.features.learned import one_thread

    n = len(descriptors)
    values = torch.as_tensor(descriptors, dtype=torch.float32, device=device)
    lengths = torch.as_tensor(np.linalg.norm(descriptors.astype(np.float64), axis=1), device=device)
    inverse = 1 / torch.where(lengths > 0, lengths, 1).float()
    best = torch.full((n,), -torch.inf, device=device)
    tile = 512  # along a side of a product that fits into the cache
    tiles = tqdm(range(0, n, tile), "landmarks: ambiguity", delay=2.0, unit="tile", disable=not progress)
    with one_thread():  # products are small: several threads would mostly wait for one another
        for i in tiles:
            for j in range(i, n, tile):  # each pair of tiles once: its product serves rows and columns
                rows = slice(i, i + tile)
                columns = slice(j, j + tile)
                cosine = values[rows] @ values[columns].T
                cosine *= inverse[rows, None] * inverse[columns]
                if i == j:
                    cosine.fill_diagonal_(-torch.inf)
                best[rows] = torch.maximum(best[rows], cosine.amax(1))
                best[columns] = torch.maximum(best[columns], cosine.amax(0))
    return torch.where(best.isinf(), torch.nan, best).cpu().numpy()


def _viewing_geometry(model: ModelArrays) -> dict[str, NDArray[np.float32]]:
    """Attributes of landmarks that follow from the positions of their mapping cameras."""
    start = model.observation_start
    lengths = np.diff(start)

    def mean_of(values: Float) -> Float:
        """Means over each landmark's observations (O,)."""
        return np.asarray(np.add.reduceat(values, start[:-1]) / lengths)

    rays = np.repeat(model.points, lengths, axis=0) - model.image_centers[model.observation_image]
    distance = np.linalg.norm(rays, axis=1)
    rays /= np.maximum(distance, 1e-12)[:, None]
    direction = np.add.reduceat(rays, start[:-1]) / lengths[:, None]
    length = np.linalg.norm(direction, axis=1)
    angle = np.zeros(len(lengths))
    for n in np.unique(lengths):  # tracks of one length at a time, so that all pairs of rays are one product
        members = np.flatnonzero(lengths == n)
        for block in np.array_split(members, -(-len(members) * int(n) ** 2 // 4_000_000)):
            track = rays[start[block][:, None] + np.arange(n)]
            angle[block] = np.degrees(np.arccos(np.clip((track @ track.swapaxes(1, 2)).min((1, 2)), -1, 1)))
    mean_distance = mean_of(distance)
    deviation = np.sqrt(mean_of((distance - np.repeat(mean_distance, lengths)) ** 2))
    attributes = {
        "mapping_focal_px": np.exp(mean_of(np.log(model.image_focal_px[model.observation_image]))),
        "triangulation_angle_deg": angle,
        "mapping_direction": direction / np.maximum(length, 1e-12)[:, None],
        "mapping_direction_spread": np.clip(1 - length, 0, 1),
        "mapping_distance_m": mean_distance,
        "mapping_distance_spread": deviation / np.maximum(mean_distance, 1e-12),
    }
    return {name: value.astype(np.float32) for name, value in attributes.items()}


def _mean_descriptors(model: ModelArrays, observations: NDArray[Any], kind: DescriptorKind) -> NDArray[Any]:
    """Mean descriptor (P, D) of each point's observations (O, D), of unit length, as its kind is stored."""
    start = model.observation_start
    mean = np.empty((len(start) - 1, observations.shape[1]), dtype=observations.dtype)
    block = 4096  # landmarks whose tracks are gathered at a time
    for first in range(0, len(mean), block):
        ends = start[first : first + block + 1]
        track = unit_descriptors(observations[ends[0] : ends[-1]])
        mean[first : first + block] = kind.store(unit_descriptors(np.add.reduceat(track, ends[:-1] - ends[0])))
    return mean
