"""The map that everything else is computed from, and where a model's features and photographs are."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.features.extractor import SIFT, DescriptorKind, ExtractorConfig, kind_of, runnable_extractors
from wheretolook.geometry.camera import Camera, cameras_by_id
from wheretolook.geometry.poses import Float
from wheretolook.mapping.colmap_model import (
    LANDMARKS_FILE,
    ModelArrays,
    compact_poses,
    find_camera,
    holds_model,
    model_arrays,
    read_model,
    registered_names,
    select_points,
)
from wheretolook.mapping.config import FrameOptions
from wheretolook.mapping.feature_files import DATABASE_FILE, HDF5_SUFFIXES, features_kind, kind_in_name
from wheretolook.mapping.georeference import REPORT_FILE
from wheretolook.mapping.landmarks import Landmarks, landmarks_of, load_colmap_landmarks
from wheretolook.mapping.map_frame import IDENTITY, MapFrame, find_frame, has_photographs
from wheretolook.utils.errors import ConfigError, MapError, MapWarning, from_record
from wheretolook.utils.files import path_within, read_json_object
from wheretolook.utils.texts import LOG


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


def choose_features(
    model_dir: Path, reconstruction: Any, given: Path | None = None, sift_points: int = 0
) -> Path | None:
    """Choose the features that describe the landmarks of a model: `given` ones, or those next to the model.

    The ambiguity of many landmarks takes minutes, so SIFT in a COLMAP database that is not given is used only for models
    of at most `sift_points` points. Features that are
    used without being given are logged. A `MapWarning` reports features that cannot be used, and a model that seems to
    have other features than SIFT, but none that are found. A given database without descriptors, as hloc writes it,
    counts as none if others are found. Raises MapError if given features are unreadable or of another model.
    """
    if given is not None and features_kind(given, reconstruction) is not None:
        return given
    found = find_features(model_dir, reconstruction)
    kind, problem = (None, "") if found is None else _kind_or_problem(found, reconstruction)
    is_small = reconstruction.num_points3D() <= sift_points
    is_hdf5 = found is not None and found.suffix.lower() in HDF5_SUFFIXES
    if found is not None and kind is not None and (kind is not SIFT or is_hdf5 or is_small):
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


def find_source(model_dir: Path) -> tuple[Path | None, Path | None]:
    """Find the features of a model, or without any that describe its keypoints the folder of its photographs.

    A model of undistorted images, for example, has other keypoints than the database above it, and a model without
    points needs its photographs. Returns features and folder, of which one or both are None.
    """
    model = read_model(model_dir)
    features = find_features(model_dir, model)
    problem = f"{model_dir} has no points"
    if features is not None and model.num_points3D():
        problem = _kind_or_problem(features, model)[1]
        if not problem:
            return features, None
    photographs = find_photographs(model_dir)
    if photographs is None:
        return features, None
    if features is not None:
        LOG.info("features not used: %s", problem)
    return None, photographs


def find_mesh(model_dir: Path) -> Path | None:
    """Find a mesh next to a model: GLB, OBJ or PLY with faces, in its folder or the two above; None without any."""
    for folder in (model_dir, *_above(model_dir)[:2]):
        for path in sorted(folder.glob("*")):
            suffix = path.suffix.lower()
            if path.is_file() and (suffix in (".glb", ".obj") or (suffix == ".ply" and _has_faces(path))):
                return path
    return None


def _has_faces(path: Path) -> bool:
    """Return whether a PLY file has faces, by its header; COLMAP's fused.ply is a cloud of points."""
    with suppress(OSError), path.open("rb") as file:
        return re.search(rb"element face [1-9]", file.read(4096)) is not None
    return False


def has_image(folder: Path, name: str) -> bool:
    """Test whether a folder has an image of a model, by its name, which must not leave the folder."""
    try:
        return path_within(folder, name, "the name of an image of the model").is_file()
    except ConfigError:
        return False


def _above(model_dir: Path) -> list[Path]:
    """The folders above a model, the nearest first."""
    return [*model_dir.absolute().parents[:4]]  # hloc's models are in outputs/sfm/models/0


def _kind_or_problem(path: Path, reconstruction: Any) -> tuple[DescriptorKind | None, str]:
    """The kind of the descriptors in a file of features of a model, or why they cannot be used."""
    try:
        kind = features_kind(path, reconstruction)
    except MapError as error:
        return None, str(error)
    return kind, "" if kind else f"{path} has no descriptors of a known kind"


def extractor_of(map_dir: Path, kind: DescriptorKind | None) -> ExtractorConfig:
    """Return the extractor in the report of a map of this project, or the first one with descriptors of a kind.

    None is any kind, without a report SIFT. Raises MapError if none of it can be run.
    """
    with suppress(OSError, ValueError, KeyError, TypeError):
        stated: Any = read_json_object(map_dir / REPORT_FILE)["config"]["extractor"]
        recorded = from_record(ExtractorConfig, stated)
        if kind in (None, kind_of(recorded.method)):  # not if the descriptors come from elsewhere
            return recorded
    for name in runnable_extractors():
        if kind in (None, kind_of(name)):
            return ExtractorConfig(name)
    problem = "no extractor for the descriptors of this map can be run here"
    raise MapError(problem, path=map_dir, value=kind and kind.name, fix="Map with SIFT, ALIKED, DISK or XFeat.")


def source_of_map(map_dir: Path) -> Path | None:
    """Return the model or the photographs that a scene's map was made from; None for a rendered map, or none."""
    return _reported(map_dir, "existing", "model") or _reported(map_dir, "photographs", "images")


def reads_upright(model_dir: Path) -> bool:
    """Test whether a map was made from photographs turned upright by EXIF; COLMAP and hloc read them as stored."""
    try:
        report = read_json_object(model_dir / REPORT_FILE)
    except (OSError, ValueError):
        return False
    return bool(report.get("upright", _reported(model_dir, "photographs", "images") is not None))


def _reported(model_dir: Path, group: str, name: str) -> Path | None:
    """A path among the settings in a map's report; None if there is none."""
    try:
        return Path(read_json_object(model_dir / REPORT_FILE)["config"][group][name])
    except (OSError, ValueError, KeyError, TypeError):
        return None


@dataclass(frozen=True, eq=False)
class Map:
    """A Structure-from-Motion map in the world: metres, z up.

    Attributes:
        landmarks: points with their attributes and descriptors.
        mapping_poses: (M, 3, 4) cam_from_world of the mapping images, as `compact_poses`; None if unknown.
        frame: the map's own frame, in which users give and get coordinates.
        has_photographs: whether the mapping images are photographs, see `scorers.set.score.for_map`.
        path: folder of its COLMAP model.
        cameras: of the model by camera_id; empty if not read.
        images: the mapping images with their observations, in the world; all points are landmarks. None if unknown.
        whole: the map that this is a part of, if some of its photographs are held out.
        computed: what is computed once for the map, such as its points on a device.
    """

    landmarks: Landmarks
    mapping_poses: Float | None = None
    frame: MapFrame = IDENTITY
    has_photographs: bool = False
    path: Path | None = None
    cameras: Mapping[int, Camera] = field(default_factory=dict)
    images: ModelArrays | None = None
    whole: Map | None = None
    computed: dict[Any, Any] = field(default_factory=dict, init=False)

    @classmethod
    def open(
        cls,
        path: str | Path,
        database: str | Path | None = None,
        frame: FrameOptions = FrameOptions(),
        max_reprojection_error_px: float | None = None,
        device: str = "cpu",
        depth_scale: float | None = None,
    ) -> Map:
        """Open any COLMAP model (version 3 or 4, binary or text), of any unit and direction up.

        A `MapWarning` states which points are left out, and what was assumed of an unknown unit or direction up.
        Without a database torch and Warp are not imported: importing them takes longer than reading 200,000 landmarks.

        Args:
            path: folder of the model.
            database: the COLMAP database the model was built from, or hloc's features in HDF5, for the landmarks'
                ambiguity, which is unknown without; by default as `choose_features`.
            frame: how the model's own frame is related to metres with z up.
            max_reprojection_error_px: landmarks with a larger mean error are left out. None for all that the model's
                own mapper kept.
            device: where the ambiguity is computed.
            depth_scale: metres in a unit of the model by depth images, if there are any.

        Raises:
            MapError: no usable model in the folder, or the database is unreadable or another's.
            ConfigError: two sources of the scale disagree.
        """
        path = Path(path)
        model = read_model(path)
        given = None if database is None else Path(database)
        chosen = choose_features(path, model, given, 30_000)  # a search of seconds
        arrays, found = _in_world(path, model, frame, depth_scale)
        try:
            landmarks = load_colmap_landmarks(path, chosen, max_reprojection_error_px, device, model, arrays=arrays)
        except MapError as error:
            if chosen is None or error.path is None or Path(error.path) != chosen or given is not None:
                raise
            warnings.warn(f"{error}; it is not used", MapWarning, stacklevel=2)
            landmarks = load_colmap_landmarks(path, None, max_reprojection_error_px, device, model, arrays=arrays)
        found.warn(path, landmarks.mapping_distance_m, arrays.image_poses)
        return cls._of_model(path, model, arrays, landmarks, found)

    @classmethod
    def open_described(
        cls, path: Path, database: Path | None = None, frame: FrameOptions = FrameOptions(), device: str = "cpu"
    ) -> Map:
        """Open a COLMAP model with the descriptors of its landmarks, to localize; without warnings and ambiguity.

        Descriptors are those in the file of landmarks of a map of this project, unless a database is given; otherwise
        those of the given features, or of any next to the model (`find_features`). Raises MapError as `open`, and if
        there are none.
        """
        model = read_model(path)
        arrays, found = _in_world(path, model, frame)
        stored = path / LANDMARKS_FILE
        kept = Landmarks.load(stored) if database is None and stored.is_file() else None
        is_described = kept is not None and kept.descriptors is not None
        features = None if is_described else database or find_features(path, model)
        landmarks = load_colmap_landmarks(path, features, None, device, model, arrays=arrays, ambiguity=False)
        if kept is not None and is_described:
            if not np.array_equal(kept.ids, landmarks.ids):
                problem = "the file has other landmarks than the model"
                raise MapError(problem, path=stored, fix="Give --database, or run the map stage again.")
            landmarks = replace(landmarks, descriptors=kept.descriptors, described_by=kept.described_by)
        if landmarks.descriptors is None:
            photographs = find_photographs(path) or "PHOTOGRAPHS"
            fix = "Give --database: the model's database.db, or hloc's feats-*.h5. Without these, "
            fix += f"`wheretolook map --model {path} --images {photographs}` makes a map with features."
            raise MapError("the landmarks have no descriptors, so nothing can be localized", path=path, fix=fix)
        return cls._of_model(path, model, arrays, landmarks, found)

    @classmethod
    def _of_model(cls, path: Path, model: Any, arrays: ModelArrays, landmarks: Landmarks, frame: MapFrame) -> Map:
        return cls(
            landmarks=landmarks,
            mapping_poses=compact_poses(arrays.image_poses),
            frame=frame,
            has_photographs=has_photographs(path),
            path=path,
            cameras=cameras_by_id(model.cameras, path),
            images=arrays.of_points(landmarks.ids),
        )

    def camera(self, camera: Camera | int | None = None) -> Camera:
        """Return a camera, given as one or by its camera_id in the model; None for the only one.

        Raises MapError, naming the model, if there is no such camera, or there are several.
        """
        return find_camera(self.cameras, self.path or Path(), camera)

    def with_images(self) -> Map:
        """Return the map with its photographs and cameras, read from the model in `path`; as it is if there are none."""
        if self.images is not None or not self.has_photographs or self.path is None or not holds_model(self.path):
            return self
        model = read_model(self.path)
        images = model_arrays(model).of_points(self.landmarks.ids)
        return replace(self, cameras=cameras_by_id(model.cameras, self.path), images=images)

    def without(self, images: ModelArrays, held_out: NDArray[np.int64]) -> Landmarks:
        """Return the landmarks with at least two observations in images that are not held out, rows of `images`.

        They have the attributes of those tracks. Coordinates, errors and ambiguities stay as they are. `images` are
        those of the map, or some of their points.
        """
        observations = ~np.isin(images.observation_image, held_out)
        counts = np.bincount(images.observation_point[observations], minlength=len(images.points))
        left = replace(
            images,
            observation_start=np.concatenate([[0], np.cumsum(counts)]),
            observation_image=images.observation_image[observations],
            observation_keypoint=images.observation_keypoint[observations],
            observation_pixels=None,
        )
        return landmarks_of(self.landmarks, select_points(left, counts >= 2))


def _in_world(
    path: Path, model: Any, frame: FrameOptions, depth_scale: float | None = None
) -> tuple[ModelArrays, MapFrame]:
    """Return a model as arrays in the world, and its own frame."""
    arrays = model_arrays(model)
    found = find_frame(path, model, frame, depth_scale, arrays)
    return found.of_arrays(arrays), found
