"""Open the map to check: its model, the features of its photographs, and the unit of its limits."""

from __future__ import annotations

import shutil
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.dataset.thresholds import THRESHOLDS
from wheretolook.features.config import ExtractorConfig
from wheretolook.geometry.camera import Camera, cameras_by_id
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.geometry.similarity import Similarity
from wheretolook.localization.versions import versions
from wheretolook.mapping.colmap_model import ModelArrays, colmap_poses, model_arrays, read_model, registered_names
from wheretolook.mapping.config import ExistingModelConfig, FrameOptions, MapConfig, PhotographsConfig, place_name
from wheretolook.mapping.feature_files import DATABASE_FILE, read_descriptors
from wheretolook.mapping.georeference import read_scale
from wheretolook.mapping.gravity import estimate_gravity
from wheretolook.mapping.sanity import up_axis_warning
from wheretolook.mapping.sources import find_features, find_photographs
from wheretolook.utils.artifact_cache import ArtifactCache, cache_key
from wheretolook.utils.confine import safe_child
from wheretolook.utils.errors import MapError, MapWarning
from wheretolook.utils.files import fingerprint, size_and_time
from wheretolook.utils.logs import LOG

MAX_ERROR_M, MAX_ERROR_DEG = THRESHOLDS[0]  # below both, a photograph counts as localized
MAX_ERROR_OF_DEPTH = 0.01  # instead of MAX_ERROR_M where metres are unknown: of the photograph's median depth
DEPTH_M = MAX_ERROR_M / MAX_ERROR_OF_DEPTH
"""Median depth that a map without metres is scaled to. There the two limits on the position agree, and scorers, which
were trained in rooms, see distances as in rooms."""
PLACE_OF_DEPTH = 0.1
"""Views whose cameras are within this share of the map's median depth (0.5 m in a room of 5 m) share a place: what can
be seen hardly changes within it, so that mostly the direction decides."""
CHECKS = "checks"  # folder of the folders of checks, next to the datasets
WORK = "work"  # folder of cached work, in that of a check
MIN_PHOTOGRAPHS = 20  # with fewer, blocks are too small
MIN_OBSERVED = 10  # landmarks that the median photograph observes


@dataclass(frozen=True, eq=False)
class PhotographedMap:
    """A map, and what its I photographs, in the order of their ids in the model, show of it.

    The model is turned upright if its cameras seem not to be, and where metres are unknown scaled to a median depth of
    `DEPTH_M`.

    Attributes:
        name: for results.
        path: folder of the model.
        model: `pycolmap.Reconstruction`, turned and scaled.
        arrays: the same as arrays.
        features: COLMAP database or hloc's HDF5 file with keypoints and descriptors of the photographs.
        is_metric: whether the unit is known to be a metre.
        from_model: transform from the model's own frame.
        frame: (I,) number, from 0, of the rig frame that each photograph belongs to.
        cameras: of each photograph.
        poses: (I, 3, 4) cam_from_world.
        own_centers: (I, 3) camera centres in the model's own frame and unit.
        depth_m: (I,) median depth of the landmarks that each observes, NaN where it observes none.
        key: changes with the model and the features.
    """

    name: str
    path: Path
    model: Any
    arrays: ModelArrays
    features: Path
    is_metric: bool
    from_model: Similarity
    frame: NDArray[np.int64]
    cameras: tuple[Camera, ...]
    poses: Float
    own_centers: Float
    depth_m: Float
    key: str

    @property
    def names(self) -> list[str]:
        """Names of the photographs, (I,)."""
        return self.arrays.image_names

    @property
    def limit_m(self) -> Float:
        """Limits (I,) of the position error of localized photographs."""
        if self.is_metric:
            return np.full(len(self.poses), MAX_ERROR_M)
        typical = float(np.nanmedian(self.depth_m))
        return MAX_ERROR_OF_DEPTH * np.where(np.isfinite(self.depth_m), self.depth_m, typical)

    @property
    def place_radius(self) -> float:
        """Maximum distance in m of the cameras of views that share a place."""
        return PLACE_OF_DEPTH * (DEPTH_M if not self.is_metric else float(np.nanmedian(self.depth_m)))

    @property
    def is_turned(self) -> bool:
        """Whether the model was turned upright."""
        return not np.array_equal(self.from_model.rotation, np.eye(3))

    @property
    def unit(self) -> str:
        """Name of the unit of the model's own frame."""
        return "m" if self.is_metric else "map units"


def open_map(
    model_dir: Path, features: Path, metric: bool, name: str | None = "", keep_frame: bool = False
) -> PhotographedMap:
    """Open a COLMAP model and the features that it was built from as a map to check.

    Args:
        model_dir: folder of the model.
        features: of its photographs.
        metric: whether the model is in metres.
        name: for results; by default the model's.
        keep_frame: whether the model has z up, whatever its cameras look like.

    Raises:
        MapError: the model or the features cannot be used or do not belong together, the features are of an unknown
            kind, or the model has fewer than `MIN_PHOTOGRAPHS` photographs.
    """
    model = read_model(model_dir)
    _check_photographs(model, model_dir)
    if model.num_points3D() == 0:
        fix = "Triangulate it, or give the folder of its photographs: --images."
        raise MapError("the model has no points", path=model_dir, fix=fix)
    poses = colmap_poses(model_dir, model)
    own_centers = camera_centers(poses)
    arrays = model_arrays(model)
    observed = float(np.median(np.bincount(arrays.observation_image, minlength=len(poses))))
    if observed < MIN_OBSERVED:
        problem = f"half of the photographs observe fewer than {MIN_OBSERVED} landmarks"
        fix = "Give a model with tracks, and the photographs it was made from."
        raise MapError(problem, path=model_dir, value=observed, fix=fix)
    rotation = np.eye(3) if keep_frame or not up_axis_warning(poses) else estimate_gravity(poses).rotation
    scale = 1.0 if metric else DEPTH_M / float(np.nanmedian(_median_depths(arrays, poses)))
    to_frame = Similarity(scale, rotation, np.zeros(3))
    if scale != 1 or not np.array_equal(rotation, np.eye(3)):
        to_frame.transform_model(model)
        poses = colmap_poses(model_dir, model)
        arrays = model_arrays(model)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MapWarning)  # the error below replaces it
        if read_descriptors(features, model, arrays) is None:
            fix = "Give hloc's feats-*.h5, --database, or the folder of its photographs, --images, to extract features."
            raise MapError("there are no descriptors of a known kind", path=features, fix=fix)
    cameras = cameras_by_id(model.cameras, model_dir)
    images = [model.images[int(number)] for number in arrays.image_ids]
    return PhotographedMap(
        name=name or place_name(model_dir),
        path=model_dir,
        model=model,
        arrays=arrays,
        features=features,
        is_metric=metric,
        from_model=to_frame,
        frame=np.unique([image.frame_id for image in images], return_inverse=True)[1].reshape(-1).astype(np.int64),
        cameras=tuple(cameras[image.camera_id] for image in images),
        poses=poses,
        own_centers=own_centers,
        depth_m=_median_depths(arrays, poses),
        key=cache_key(_fingerprints(model_dir), size_and_time([features.resolve()]), metric, keep_frame),
    )


def _check_photographs(model: Any, model_dir: Path) -> None:
    n_posed = sum(image.has_pose for image in model.images.values())
    if n_posed < MIN_PHOTOGRAPHS:
        problem = f"a check needs at least {MIN_PHOTOGRAPHS} photographs"
        fix = "Take more photographs, and map them all."
        raise MapError(problem, path=model_dir, value=n_posed, fix=fix)


def _fingerprints(model_dir: Path) -> list[str]:
    return [fingerprint(path) for path in sorted(model_dir.glob("*.bin")) + sorted(model_dir.glob("*.txt"))]


def folder_of_check(data: Path, name: str) -> Path:
    """Return the folder of a check's results, by its name; ConfigError if it would be outside the folder of checks."""
    return safe_child(safe_child(data, CHECKS, "the folder of all checks"), name, "the name of a check")


def features_of(
    model_dir: Path,
    images: Path | None,
    database: Path | None,
    work: Path,
    workers: int,
    device: str,
    extractor: ExtractorConfig = ExtractorConfig(),
) -> tuple[Path, Path]:
    """Return the folder of a map's model, and the features of its photographs: given ones or those next to the model.

    With the folder of the photographs alone, keypoints are extracted and the landmarks triangulated again in `work`.
    Raises MapError if neither features nor photographs are known, or the photographs are not those of the model.
    """
    if images is None and database is None:
        database = find_features(model_dir)
        images = find_photographs(model_dir) if database is None else None
        LOG.info("%s: %s", "features" if database else "photographs", database or images or "not found")
    if database is not None:
        return model_dir, database
    model = read_model(model_dir)
    if images is None:
        fix = "Give --database, the database.db that it was built from, or --images, the folder of its photographs."
        raise MapError("neither the features nor the photographs of this map are known", path=model_dir, fix=fix)
    from wheretolook.mapping.imported_map import map_existing

    out = work / "map"
    files = size_and_time(path for name in registered_names(model).values() if (path := images / name).is_file())
    key = cache_key(versions(), _fingerprints(model_dir), images.resolve(), files, extractor.record())
    cache = ArtifactCache(work, key, step="map", manifest="map.json")
    if cache.is_current(out / DATABASE_FILE):
        return out, out / DATABASE_FILE
    _check_photographs(model, model_dir)
    shutil.rmtree(out, ignore_errors=True)
    existing = ExistingModelConfig(model=model_dir, frame=FrameOptions(scale=1, up="z"))  # check scales it
    photographs = PhotographsConfig(images=images)
    config = MapConfig(existing=existing, photographs=photographs, extractor=extractor, keep_database=True)
    work.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MapWarning)  # about the frame, which `open_map` corrects
        map_existing(config, out, work / "photographs", workers=workers, device=device, reconstruction=model)
    cache.store()
    return out, out / DATABASE_FILE


def says_metric(model_dir: Path) -> bool:
    """Whether the report next to a map states that it is in metres."""
    scale = read_scale(model_dir)
    return scale is not None and scale.is_metric


def _median_depths(arrays: ModelArrays, poses: Float) -> Float:
    """Median depth (I,) of the landmarks that each image observes, from poses (I, 3, 4); NaN where it observes none."""
    point = np.repeat(arrays.points, np.diff(arrays.observation_start), axis=0)
    axis = poses[arrays.observation_image, 2]
    depth = pd.Series((axis[:, :3] * point).sum(1) + axis[:, 3])
    return depth.groupby(arrays.observation_image).median().reindex(range(len(poses))).to_numpy()
