"""Opens the map that is checked: its model, the features of its photographs, and the unit that limits are in."""

from __future__ import annotations

import hashlib
import json
import shutil
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.names import check_scene_name, no_such_scene
from wheretolook.dataset.thresholds import THRESHOLDS
from wheretolook.features.config import ExtractorConfig
from wheretolook.geometry.camera import Camera, cameras_by_id
from wheretolook.geometry.poses import Float, camera_centers, transform
from wheretolook.localization.labeller import versions
from wheretolook.mapping.colmap_model import ModelArrays, colmap_poses, model_arrays, read_model, registered_names
from wheretolook.mapping.config import ExistingModelConfig, MapConfig, PhotographsConfig
from wheretolook.mapping.feature_files import read_descriptors
from wheretolook.mapping.georeference import Similarity, read_scale
from wheretolook.mapping.gravity import estimate_gravity
from wheretolook.mapping.rendered_map import DATABASE_FILE
from wheretolook.mapping.sanity import axes_doubt
from wheretolook.mapping.sources import features_beside, photographs_of
from wheretolook.utils.confine import safe_child
from wheretolook.utils.errors import ConfigError, MapError, MapWarning
from wheretolook.utils.files import fingerprint, write_text
from wheretolook.utils.reading import read_json_object

MAX_ERROR_M, MAX_ERROR_DEG = THRESHOLDS[0]  # below both, a photograph counts as localized
MAX_ERROR_OF_DEPTH = 0.01  # instead, of the median depth of what the photograph observes, where metres are not known
DEPTH_M = MAX_ERROR_M / MAX_ERROR_OF_DEPTH
"""Median depth that a map without metres is brought to. There the two limits on the position agree, and scorers, which
have learnt in rooms, see distances as in rooms."""
CHECKS = "checks"  # folder of the folders of checks, beside the datasets
WORK = "work"  # folder, in that of a check, of what it has finished and need not do again
LEAST_PHOTOGRAPHS = 20  # of fewer, blocks are too small to tell anything
LEAST_OBSERVED = 10  # landmarks that the median photograph observes; fewer are accidents


@dataclass(frozen=True, eq=False)
class PhotographedMap:
    """A map, and what its photographs show of it. Photographs are rows, in the order of their ids in the model.

    The model is turned upright if its cameras seem not to be, and where metres are not known scaled to a median depth
    of `DEPTH_M`: `from_model` has done so; `own_centers` stay in the model's frame and unit.
    """

    name: str  # what results call it
    path: Path  # the folder of the model
    model: Any  # `pycolmap.Reconstruction`
    arrays: ModelArrays  # the same as arrays
    features: Path  # the COLMAP database, or hloc's HDF5 file, that holds keypoints and descriptors of its photographs
    is_metric: bool  # whether its unit is known to be a metre
    from_model: Similarity  # from the model's own frame
    moment: NDArray[np.int64]  # (I,) what was taken at one moment by a rig of cameras has one number, from 0
    cameras: tuple[Camera, ...]  # of each of the I photographs
    poses: Float  # (I, 3, 4) cam_from_world
    own_centers: Float  # (I, 3) camera centres in the model's own frame and unit
    depth_m: Float  # (I,) median depth of the landmarks that each observes, NaN where it observes none
    key: str  # changes with the model and the features

    @property
    def names(self) -> list[str]:
        """Of the photographs, (I,)."""
        return self.arrays.image_names

    @property
    def limit_m(self) -> Float:
        """Errors of the position below which photographs count as localized, (I,)."""
        if self.is_metric:
            return np.full(len(self.poses), MAX_ERROR_M)
        typical = float(np.nanmedian(self.depth_m))
        return MAX_ERROR_OF_DEPTH * np.where(np.isfinite(self.depth_m), self.depth_m, typical)

    @property
    def is_turned(self) -> bool:
        """Whether the model was turned upright."""
        return not np.array_equal(self.from_model.rotation, np.eye(3))

    @property
    def unit(self) -> str:
        """What lengths of the model's own frame are told in."""
        return "m" if self.is_metric else "map units"


def open_map(
    model_dir: Path, features: Path, metric: bool, name: str = "", keep_frame: bool = False, reconstruction: Any = None
) -> PhotographedMap:
    """A map to check, from a COLMAP model and the features that it was built from.

    `metric` says whether the model is in metres; `keep_frame` that it has z up, whatever it looks like. A
    `reconstruction` is the model if it has been read already; it is turned and scaled in place.

    Raises MapError if the model or the features cannot be used or do not belong together, the features are of no known
    kind, or the model has fewer than `LEAST_PHOTOGRAPHS` photographs.
    """
    model = reconstruction or read_model(model_dir)
    n_posed = sum(image.has_pose for image in model.images.values())
    if n_posed < LEAST_PHOTOGRAPHS:
        fix = "Take more photographs of the place, and map them all."
        raise MapError(
            f"a check needs at least {LEAST_PHOTOGRAPHS} photographs", path=model_dir, value=n_posed, fix=fix
        )
    if model.num_points3D() == 0:
        fix = "Triangulate it, or give the folder of its photographs: --images."
        raise MapError("the model has no points", path=model_dir, fix=fix)
    own_centers = camera_centers(colmap_poses(model_dir, model))
    poses = colmap_poses(model_dir, model)
    arrays = model_arrays(model)
    observed = np.bincount(arrays.observation_image, minlength=len(poses))
    if np.median(observed) < LEAST_OBSERVED:
        problem = f"half of the photographs observe fewer than {LEAST_OBSERVED} landmarks"
        fix = "Give a model with tracks, and the photographs it was made from."
        raise MapError(problem, path=model_dir, value=float(np.median(observed)), fix=fix)
    rotation = np.eye(3) if keep_frame or not axes_doubt(poses) else estimate_gravity(poses).rotation
    scale = 1.0 if metric else DEPTH_M / float(np.nanmedian(_median_depths(arrays, poses)))
    to_frame = Similarity(scale, rotation, np.zeros(3))
    if scale != 1 or not np.array_equal(rotation, np.eye(3)):
        to_frame.transform_model(model)
        poses = colmap_poses(model_dir, model)
        arrays = model_arrays(model)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MapWarning)  # the error below tells the same
        if read_descriptors(features, model_dir, model, arrays) is None:
            fix = "Give the folder of its photographs instead, --images: then keypoints are extracted from them."
            problem = "these features are of no kind that is known, so nothing can be localized by them"
            raise MapError(problem, path=features, fix=fix)
    known = cameras_by_id(model.cameras, model_dir)
    images = [model.images[int(number)] for number in arrays.image_ids]
    parts = [fingerprint(path) for path in sorted(model_dir.glob("*.bin")) + sorted(model_dir.glob("*.txt"))]
    parts += [
        f"{features.resolve()} {features.stat().st_size} {features.stat().st_mtime_ns}",
        str((metric, keep_frame)),
    ]
    return PhotographedMap(
        name=name or ExistingModelConfig(model=model_dir).scene_name,
        path=model_dir,
        model=model,
        arrays=arrays,
        features=features,
        is_metric=metric,
        from_model=to_frame,
        moment=np.unique([image.frame_id for image in images], return_inverse=True)[1].reshape(-1).astype(np.int64),
        cameras=tuple(known[image.camera_id] for image in images),
        poses=poses,
        own_centers=own_centers,
        depth_m=_median_depths(arrays, poses),
        key=digest_of(parts),
    )


def folder_of_check(data: Path, name: str) -> Path:
    """Where the results of a check go, of this name and without a folder given, there already or not.

    Raises ConfigError if it would lie elsewhere, by its name or by a link.
    """
    return safe_child(safe_child(data, CHECKS, "the folder of all checks"), name, "the name of a check")


def find_scene(data: Path, name: str, dataset: str = "") -> SceneFolder:
    """The scene of a name in a dataset, or in the only one of a folder of datasets that has it.

    Raises ConfigError if there is none, or several datasets have it; TableError if the dataset is damaged.
    """
    check_scene_name(data, name, dataset)
    if dataset:
        return Dataset.load(data / dataset).scene(name)
    roots = [path.parent for path in sorted(data.glob("*/dataset.json"))]
    # a dataset without such a folder is not read, so that a damaged one is not in the way
    found = [Dataset.load(root) for root in roots if (root / name).is_dir()]
    having = [one for one in found if name in {scene.name for scene in one.scenes}]
    if len(having) == 1:
        return having[0].scene(name)
    if having:
        names = ", ".join(one.name for one in having)
        raise ConfigError("several datasets have such a scene", value=name, fix=f"Give --name: {names}.")
    no_such_scene(data, name, roots)


def features_of(
    model_dir: Path,
    images: Path | None,
    database: Path | None,
    work: Path,
    workers: int,
    device: str,
    extractor: ExtractorConfig = ExtractorConfig(),
) -> tuple[Path, Path]:
    """The folder of a map's model, and the features of its photographs: those given or those that are found.

    From the folder of the photographs alone both are made anew, in `work` (`extract_anew`). Raises MapError if neither
    features nor photographs are known.
    """
    if images is None and database is None:
        database = features_beside(model_dir)
        images = photographs_of(model_dir) if database is None else None
    if database is not None:
        return model_dir, database
    if images is None:
        read_model(model_dir)  # if there is no model at all, that is said
        fix = "Give --database, the database.db that it was built from, or --images, the folder of its photographs."
        raise MapError("neither the features nor the photographs of this map are known", path=model_dir, fix=fix)
    return extract_anew(model_dir, images, work, workers, device, extractor)


def says_metric(model_dir: Path) -> bool:
    """Whether the report beside a map says that it is in metres."""
    scale = read_scale(model_dir)
    return scale is not None and scale.is_metric


def extract_anew(
    model_dir: Path, images: Path, work: Path, workers: int, device: str, extractor: ExtractorConfig = ExtractorConfig()
) -> tuple[Path, Path]:
    """Triangulate a model's landmarks anew, from keypoints of its photographs; kept in `work`.

    Returns the folder of the new model and its database. Raises MapError if the photographs are not those of the model.
    """
    from wheretolook.mapping.imported_map import map_existing

    out = work / "map"
    note = work / "map.json"
    model = read_model(model_dir)
    parts = [fingerprint(path) for path in sorted(model_dir.glob("*.bin")) + sorted(model_dir.glob("*.txt"))]
    files = [[name, *_size_and_time(images / name)] for name in registered_names(model).values()]
    key: dict[str, Any] = {"versions": versions(), "model": parts, "images": str(images.resolve())}
    key["photographs"] = digest_of(files)
    if extractor != ExtractorConfig():
        key["extractor"] = extractor.record()
    try:
        if read_json_object(note) == key and (out / DATABASE_FILE).is_file():
            return out, out / DATABASE_FILE
    except (OSError, ValueError):
        pass
    n_posed = sum(image.has_pose for image in model.images.values())
    if n_posed < LEAST_PHOTOGRAPHS:
        fix = "Take more photographs of the place, and map them all."
        raise MapError(
            f"a check needs at least {LEAST_PHOTOGRAPHS} photographs", path=model_dir, value=n_posed, fix=fix
        )
    note.unlink(missing_ok=True)
    shutil.rmtree(out, ignore_errors=True)
    existing = ExistingModelConfig(model=model_dir)
    photographs = PhotographsConfig(images=images)
    config = MapConfig(existing=existing, photographs=photographs, extractor=extractor, keep_database=True)
    work.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MapWarning)  # of the frame, which is seen to here
        map_existing(config, out, work / "photographs", workers=workers, device=device, reconstruction=model)
    write_text(note, json.dumps(key) + "\n")
    return out, out / DATABASE_FILE


def _size_and_time(path: Path) -> tuple[int, int]:
    """Bytes of a file, and when it was changed; zeros if it is missing, which is told where it is read."""
    try:
        return path.stat().st_size, path.stat().st_mtime_ns
    except OSError:
        return 0, 0


def digest_of(values: Any) -> str:
    """16 hexadecimal digits that change with values of JSON."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]


def _median_depths(arrays: ModelArrays, poses: Float) -> Float:
    """Median depth of the landmarks that each of the images (I, 3, 4) observes, (I,); NaN where it observes none."""
    point = np.repeat(np.arange(len(arrays.points)), np.diff(arrays.observation_start))
    order = np.argsort(arrays.observation_image, kind="stable")
    ends = np.searchsorted(arrays.observation_image[order], np.arange(len(poses) + 1))
    depths = np.full(len(poses), np.nan)
    for row, pose in enumerate(poses):
        seen = point[order[ends[row] : ends[row + 1]]]
        if len(seen):
            depths[row] = np.median(transform(pose, arrays.points[seen])[:, 2])
    return depths
