"""Mapping images with their observations, and where a model's features and photographs are."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from wheretolook.features.extractor import SIFT, DescriptorKind
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float
from wheretolook.mapping.colmap_model import (
    ModelArrays,
    camera_of_model,
    cameras_of_images,
    colmap_poses,
    compact_poses,
    model_arrays,
    read_model,
    registered_names,
    select_points,
)
from wheretolook.mapping.config import FrameOptions
from wheretolook.mapping.feature_files import DATABASE_FILE, HDF5_SUFFIXES, features_kind, kind_in_name
from wheretolook.mapping.georeference import REPORT_FILE
from wheretolook.mapping.landmarks import Landmarks, landmarks_of, load_colmap_landmarks
from wheretolook.mapping.map_frame import MapFrame, find_frame
from wheretolook.utils.errors import ConfigError, MapError, MapWarning
from wheretolook.utils.files import path_within, read_json_object
from wheretolook.utils.texts import LOG

_LEVELS = 4  # folders above a model that are searched: hloc's models are in outputs/sfm/models/0


def find_features(model_dir: Path, reconstruction: Any = None) -> Path | None:
    """Find the file of features of a map: hloc's HDF5, COLMAP's database, or the one in its report; None without any.

    It is in the model's folder or one above it. Of several, it is the first that describes the keypoints of the model,
    `reconstruction` if it was read before.
    """
    above = _above(model_dir)
    hdf5 = [path for suffix in HDF5_SUFFIXES for path in sorted(model_dir.glob(f"*{suffix}"))]
    hdf5 += [path for folder in above for suffix in HDF5_SUFFIXES for path in sorted(folder.glob(f"feats*{suffix}"))]
    databases = [folder / DATABASE_FILE for folder in (model_dir, model_dir.parent / "photographs", *above)]
    named = _reported(model_dir, "existing", "database")
    candidates = [path for path in hdf5 if "matches" not in path.stem] + databases + ([named] if named else [])
    found = [path for path in dict.fromkeys(candidates) if path.is_file()]
    if len(found) > 1:
        model = reconstruction or read_model(model_dir)
        found = [path for path in found if _kind_or_problem(path, model)[0]] or found
    return next(iter(found), None)


def choose_features(model_dir: Path, reconstruction: Any, given: Path | None = None) -> Path | None:
    """Choose the features that describe the landmarks of a model: `given` ones, or those next to the model.

    The ambiguity of many landmarks takes minutes, so SIFT in a COLMAP database is used only if given. Features that are
    used without being given are logged. A `MapWarning` reports features that cannot be used, and a model that seems to
    have other features than SIFT, but none that are found. A given database without descriptors, as hloc writes it,
    counts as none if others are found. Raises MapError if given features are unreadable or of another model.
    """
    if given is not None and features_kind(given, reconstruction) is not None:
        return given
    found = find_features(model_dir, reconstruction)
    kind, problem = (None, "") if found is None else _kind_or_problem(found, reconstruction)
    if found is not None and kind is not None and (kind is not SIFT or found.suffix.lower() in HDF5_SUFFIXES):
        LOG.info("features: %s (%s)", found, kind.name)
        return found
    if given is None and kind is not None:
        LOG.info("features not used: %s (%s); --database gives the ambiguity of landmarks", found, kind.name)
    if given is None and kind is None:
        named = next((name for path in (model_dir, *_above(model_dir)[:2]) if (name := kind_in_name(path))), SIFT)
        if problem or named is not SIFT:
            problem = problem or f"features of {model_dir} seem to be {named.name}, but are not found"
            text = f"{problem}; views are scored by weights for SIFT, unless --database names the features"
            warnings.warn(text, MapWarning, stacklevel=3)
    return given


def find_photographs(model_dir: Path) -> Path | None:
    """Find the folder of images that a map was built from: next to it, above it, or in its report; None without any."""
    for folder in (model_dir / "images", _reported(model_dir, "photographs", "images")):
        if folder is not None and folder.is_dir():
            return folder
    folders = [path for folder in _above(model_dir) if (path := folder / "images").is_dir()]
    names = [*registered_names(read_model(model_dir)).values()] if folders else []
    return next((folder for folder in folders if any(has_image(folder, name) for name in names)), None)


def has_image(folder: Path, name: str) -> bool:
    """Test whether a folder has an image of a model, by its name, which must not leave the folder."""
    try:
        return path_within(folder, name, "the name of an image of the model").is_file()
    except ConfigError:
        return False


def _above(model_dir: Path) -> list[Path]:
    """The folders above a model, the nearest first."""
    return [*model_dir.absolute().parents[:_LEVELS]]


def _kind_or_problem(path: Path, reconstruction: Any) -> tuple[DescriptorKind | None, str]:
    """The kind of the descriptors in a file of features of a model, or why they cannot be used."""
    try:
        kind = features_kind(path, reconstruction)
    except MapError as error:
        return None, str(error)
    return kind, "" if kind else f"{path} has no descriptors of a known kind"


def source_of_map(map_dir: Path) -> Path | None:
    """Return the model or the photographs that a scene's map was made from; None for a rendered map, or none."""
    return _reported(map_dir, "existing", "model") or _reported(map_dir, "photographs", "images")


def _reported(model_dir: Path, group: str, name: str) -> Path | None:
    """A path among the settings in a map's report; None if there is none."""
    try:
        return Path(read_json_object(model_dir / REPORT_FILE)["config"][group][name])
    except (OSError, ValueError, KeyError, TypeError):
        return None


@dataclass(frozen=True, eq=False)
class MappedImages:
    """Images of a map, in the order of their ids in its model, and what they observe.

    Attributes:
        landmarks: of the map.
        arrays: its model in the world, in metres with z up; all points are landmarks.
        poses: (M, 3, 4) cam_from_world.
        cameras: (M,)
        offsets: of the log-odds of detection, once estimated, by network and occlusion.
    """

    landmarks: Landmarks
    arrays: ModelArrays
    poses: Float
    cameras: tuple[Camera, ...]
    offsets: dict[tuple[object, ...], float] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.cameras)

    @classmethod
    def of(cls, landmarks: Landmarks, arrays: ModelArrays, poses: Float, cameras: tuple[Camera, ...]) -> Self:
        """Return the images of a model, of which only the points that are landmarks count."""
        return cls(landmarks, select_points(arrays, np.isin(arrays.point_ids, landmarks.ids)), poses, cameras)

    def without(self, held_out: NDArray[np.int64]) -> Landmarks:
        """Return the landmarks with at least two observations in the other images, with the attributes of those tracks.

        `held_out` are rows of images. Coordinates, errors and ambiguities stay as they are.
        """
        arrays = self.arrays
        observations = ~np.isin(arrays.observation_image, held_out)
        point = np.repeat(np.arange(len(arrays.points)), np.diff(arrays.observation_start))
        counts = np.bincount(point[observations], minlength=len(arrays.points))
        left = replace(
            arrays,
            observation_start=np.concatenate([[0], np.cumsum(counts)]),
            observation_image=arrays.observation_image[observations],
            observation_keypoint=arrays.observation_keypoint[observations],
        )
        return landmarks_of(self.landmarks, select_points(left, counts >= 2))


def read_images(model_dir: Path, landmarks: Landmarks) -> MappedImages:
    """Read the images of a map's COLMAP model, which is in metres with z up. Raises MapError as `read_model`."""
    model = read_model(model_dir)
    of_images = colmap_poses(model_dir, model), cameras_of_images(model_dir, model)
    return MappedImages.of(landmarks, model_arrays(model), *of_images)


class ColmapSource(NamedTuple):
    """Parts of a COLMAP model in the world: metres, z up."""

    landmarks: Landmarks
    camera: Camera  # the query camera
    mapping_poses: Float  # cam_from_world (M, 3, 4) of its images
    frame: MapFrame  # of the model
    images: MappedImages  # the same images, with their cameras and observations


def open_colmap(
    model: str | Path,
    camera: Camera | int | None = None,
    database: str | Path | None = None,
    max_reprojection_error_px: float | None = None,
    device: str = "cpu",
    frame: FrameOptions = FrameOptions(),
    depth_scale: float | None = None,
) -> ColmapSource:
    """Read a COLMAP model; arguments, errors and warnings are those of `LocalizationMap.from_colmap`.

    `depth_scale` is that of `find_frame`. Without a database torch and Warp are not imported: importing them takes
    longer than reading 200,000 landmarks.
    """
    model = Path(model)
    reconstruction = read_model(model)
    database = choose_features(model, reconstruction, None if database is None else Path(database))
    arrays = model_arrays(reconstruction)
    found = find_frame(model, reconstruction, frame, depth_scale, arrays)
    arrays = found.of_arrays(arrays)
    landmarks = load_colmap_landmarks(model, database, max_reprojection_error_px, device, reconstruction, arrays=arrays)
    poses = found.world_from_map.apply_to_poses(colmap_poses(model, reconstruction))
    found.warn(model, landmarks.mapping_distance_m, poses)
    if camera is None or isinstance(camera, int):
        camera = camera_of_model(reconstruction, model, camera)
    images = MappedImages.of(landmarks, arrays, poses, cameras_of_images(model, reconstruction))
    return ColmapSource(landmarks, camera, compact_poses(poses), found, images)
