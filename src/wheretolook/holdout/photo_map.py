"""Simulates narrower views from the keypoints of photographs, so that more of them fail to localize."""

from __future__ import annotations

import shutil
import warnings
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from wheretolook.dataset.config import THRESHOLDS
from wheretolook.features.extractor import ExtractorConfig
from wheretolook.geometry.camera import Camera, PinholeCamera, cameras_by_id, field_of_view_deg
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.geometry.similarity import Similarity
from wheretolook.localization.config import versions
from wheretolook.mapping.colmap_model import ModelArrays, compact_poses, model_arrays, read_model, registered_names
from wheretolook.mapping.config import FrameOptions, ImportConfig, place_name
from wheretolook.mapping.feature_files import DATABASE_FILE, read_descriptors
from wheretolook.mapping.georeference import DEPTH_M, median_depths
from wheretolook.mapping.imported_map import map_existing
from wheretolook.mapping.landmarks import load_colmap_landmarks
from wheretolook.mapping.map import Map, find_source
from wheretolook.mapping.map_frame import IDENTITY, MapFrame, find_frame, has_photographs
from wheretolook.utils.errors import ConfigError, MapError, MapWarning
from wheretolook.utils.files import ArtifactCache, cache_key, fingerprint, size_and_time
from wheretolook.utils.texts import LOG

PANS = (0.0, -1.0, 1.0)  # of the crops of a photograph: the middle one, and those at its left and right side


@lru_cache(maxsize=64)
def crops_of(camera: Camera, fov_deg: float) -> tuple[PinholeCamera, Float]:
    """Return the pinhole of crops of a camera's images, and their rotations crop_from_camera (3, 3, 3).

    The pinhole has the camera's focal length and proportions, and the horizontal field of view `fov_deg`. Raises
    ConfigError if it is not narrower than the camera's.
    """
    whole_deg = field_of_view_deg(camera)[0]
    if not fov_deg < whole_deg:
        problem = "the photographs do not show more than the narrower views to simulate"
        raise ConfigError(problem, value=f"{fov_deg:g} of {whole_deg:.0f} degrees", fix="Give a smaller --fov.")
    focal = camera.colmap.mean_focal_px
    width = max(2, round(2 * focal * np.tan(np.radians(fov_deg) / 2)))
    pinhole = PinholeCamera(width, max(2, round(width * camera.height / camera.width)), focal)
    pans = np.multiply(PANS, (whole_deg - fov_deg) / 2)
    return pinhole, Rotation.from_euler("y", pans[:, None], degrees=True).as_matrix()


def crop_pixels(camera: Camera, pixels: Float, fov_deg: float, crop: int) -> tuple[Float, NDArray[np.bool_]]:
    """Return where pixels (K, 2) of a camera's image are in a crop, (K, 2), and which of them it shows, (K,)."""
    pinhole, rotations = crops_of(camera, fov_deg)
    rays = camera.colmap.unproject(np.asarray(pixels, dtype=np.float64)) @ rotations[crop].T
    ahead = rays[:, 2] > 1e-6
    moved = pinhole.project(np.where(ahead[:, None], rays, (0.0, 0.0, 1.0)))
    return moved, ahead & pinhole.in_image(moved)


MAX_ERROR_M, MAX_ERROR_DEG = THRESHOLDS[0]  # below both, a photograph counts as localized


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
        frame: the model's own frame.
        rig_frame: (I,) number, from 0, of the rig frame that each photograph belongs to.
        cameras: of each photograph.
        own_centers: (I, 3) camera centres in the model's own frame and unit.
        depth_m: (I,) median depth of the landmarks that each observes, NaN where it observes none.
        key: changes with the model and the features.
        fov_deg: horizontal field of view of narrower views that are simulated from each photograph; None for itself.
        photographs: False for a map of renders, see `wheretolook.mapping.map_frame.has_photographs`.
    """

    name: str
    path: Path
    model: Any
    arrays: ModelArrays
    features: Path
    frame: MapFrame
    rig_frame: NDArray[np.int64]
    cameras: tuple[Camera, ...]
    own_centers: Float
    depth_m: Float
    key: str
    fov_deg: float | None = None
    photographs: bool = True

    @property
    def n_crops(self) -> int:
        """Views of each photograph."""
        return 1 if self.fov_deg is None else len(PANS)

    def view(self, row: int, crop: int) -> tuple[Camera, Float]:
        """Return camera and pose (3, 4) of a view of a photograph."""
        if self.fov_deg is None:
            return self.cameras[row], self.poses[row]
        pinhole, rotations = crops_of(self.cameras[row], self.fov_deg)
        return pinhole, rotations[crop] @ self.poses[row]

    def pixels_in_view(self, row: int, crop: int, pixels: Float) -> tuple[Float, NDArray[np.bool_]]:
        """Return where pixels (K, 2) of a photograph are in a view of it, (K, 2), and which it shows, (K,)."""
        if self.fov_deg is None:
            return pixels, np.ones(len(pixels), dtype=bool)
        return crop_pixels(self.cameras[row], pixels, self.fov_deg, crop)

    @cached_property
    def map(self) -> Map:
        """The whole map, which scorers use."""
        with warnings.catch_warnings(action="ignore", category=MapWarning):
            landmarks = load_colmap_landmarks(self.path, self.features, reconstruction=self.model, arrays=self.arrays)
        return Map(
            landmarks,
            compact_poses(self.poses),
            has_photographs=self.photographs,
            cameras=dict(zip(self.arrays.image_cameras.tolist(), self.cameras, strict=True)),
            images=self.arrays.of_points(landmarks.ids),
        )

    @property
    def poses(self) -> Float:
        """Poses (I, 3, 4) cam_from_world."""
        return self.arrays.image_poses

    @property
    def is_metric(self) -> bool:
        """Whether the scale is known."""
        return self.frame.scale.is_metric

    @property
    def from_model(self) -> Similarity:
        """Transform from the model's own frame."""
        return self.frame.world_from_map

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
        return MAX_ERROR_M / DEPTH_M * np.where(np.isfinite(self.depth_m), self.depth_m, typical)

    @property
    def place_radius(self) -> float:
        """Maximum distance in m of the cameras of views that share a place."""
        # 0.5 m in a room of 5 m, within which mostly the direction decides
        return 0.1 * (DEPTH_M if not self.is_metric else float(np.nanmedian(self.depth_m)))


def open_map(
    model_dir: Path, features: Path, name: str = "", frame: FrameOptions = FrameOptions(), source: Path | None = None
) -> PhotographedMap:
    """Open a COLMAP model and the features that it was built from as a map to check.

    Args:
        model_dir: folder of the model.
        features: of its photographs.
        name: for results; by default the model's.
        frame: how the model's own frame is related to metres with z up.
        source: folder of the map that the model was triangulated again from, whose report and landmarks give the frame.

    Raises:
        MapError: the model or the features cannot be used or do not belong together, the features are of an unknown
            kind, or the model has fewer than 8 photographs.
    """
    model = read_model(model_dir)
    _check_photographs(model, model_dir)
    if model.num_points3D() == 0:
        fix = "Give the folder of its photographs to triangulate it: --images."
        raise MapError("the model has no points", path=model_dir, fix=fix)
    arrays = model_arrays(model)
    own_centers = camera_centers(arrays.image_poses)
    observed = float(np.median(np.bincount(arrays.observation_image, minlength=len(own_centers))))
    min_observed = 10
    if observed < min_observed:
        problem = f"half of the photographs observe fewer than {min_observed} landmarks"
        fix = "Give a model with tracks, and the photographs it was made from."
        raise MapError(problem, path=model_dir, value=observed, fix=fix)
    original = model if source in (None, model_dir) else read_model(source)
    found = find_frame(source or model_dir, original if original.num_points3D() else model, frame)
    to_frame = found.world_from_map
    if to_frame.record() != IDENTITY.world_from_map.record():
        to_frame.transform_model(model)
        arrays = model_arrays(model)
    with warnings.catch_warnings(action="ignore", category=MapWarning):  # the error below replaces it
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
        frame=found,
        rig_frame=np.unique([image.frame_id for image in images], return_inverse=True)[1].reshape(-1).astype(np.int64),
        cameras=tuple(cameras[image.camera_id] for image in images),
        own_centers=own_centers,
        depth_m=median_depths(arrays, arrays.image_poses),
        key=cache_key(_fingerprints(model_dir), size_and_time([features.resolve()]), found.record()),
        photographs=has_photographs(source or model_dir),
    )


def _check_photographs(model: Any, model_dir: Path) -> None:
    n_posed = sum(image.has_pose for image in model.images.values())
    if n_posed < 8:  # blocks would be too small
        problem = "a check needs at least 8 photographs"
        fix = "Take more photographs, and map them all."
        raise MapError(problem, path=model_dir, value=n_posed, fix=fix)


def _fingerprints(model_dir: Path) -> list[str]:
    return [fingerprint(path) for path in sorted(model_dir.glob("*.bin")) + sorted(model_dir.glob("*.txt"))]


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
        database, images = find_source(model_dir)
        LOG.info("%s: %s", "features" if database else "photographs", database or images or "not found")
    if database is not None:
        return model_dir, database
    model = read_model(model_dir)
    if images is None:
        fix = "Give --database, the database.db that it was built from, or --images, the folder of its photographs."
        raise MapError("neither the features nor the photographs of this map are known", path=model_dir, fix=fix)

    out = work / "map"
    files = size_and_time(path for name in registered_names(model).values() if (path := images / name).is_file())
    key = cache_key(versions(), _fingerprints(model_dir), images.resolve(), files, extractor.record())
    cache = ArtifactCache(work, key, step="map", manifest="map.json")
    if cache.is_current(out / DATABASE_FILE):
        return out, out / DATABASE_FILE
    _check_photographs(model, model_dir)
    shutil.rmtree(out, ignore_errors=True)
    own = FrameOptions(scale=1, up="z")
    config = ImportConfig(images, model=model_dir, frame=own, extractor=extractor, keep_database=True)
    with warnings.catch_warnings(action="ignore", category=MapWarning):  # about the frame, which `open_map` corrects
        map_existing(config, out, work / "photographs", workers=workers, device=device, reconstruction=model)
    cache.store()
    return out, out / DATABASE_FILE
