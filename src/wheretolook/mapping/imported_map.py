"""A map from a COLMAP model of one's own: as it is, turned and scaled, or triangulated anew at its poses."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array

from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.mapping import rendered_map as building
from wheretolook.mapping.colmap_model import (
    CAMERAS_FILE,
    colmap_poses,
    describe_intrinsics,
    model_arrays,
    read_model,
    registered_names,
    save_mapping_poses,
    write_model,
)
from wheretolook.mapping.config import EXHAUSTIVE_UP_TO, PARTNERS, MapConfig
from wheretolook.mapping.feature_files import HDF5_SUFFIXES
from wheretolook.mapping.frame import KnownScale, find_scale
from wheretolook.mapping.gravity import estimate_gravity
from wheretolook.mapping.landmarks import load_colmap_landmarks
from wheretolook.mapping.rendered_map import DATABASE_FILE, LANDMARKS_FILE, REPORT_FILE, Clock
from wheretolook.mapping.sanity import warn_of_frame
from wheretolook.mapping.scale import MapScale, Similarity
from wheretolook.mapping.sfm import PhotographFeatures, photograph_features
from wheretolook.mapping.triangulation import choose_pairs, color_points, triangulate_model
from wheretolook.utils.confine import path_within
from wheretolook.utils.errors import ConfigError, MapError
from wheretolook.utils.files import atomic_folder, copy_file, write_text
from wheretolook.utils.images import image_size
from wheretolook.utils.processes import WorkerPool

_PROPORTIONS = 0.01  # by which a photograph's proportions may differ from those of its camera
_ORIENTATION = 274  # number of EXIF's entry, and its values for photographs that lie on a side
_ASIDE = (5, 6, 7, 8)
_FACING_DEG = 60.0  # cameras that look in directions farther apart are not matched where no points say what they share


@dataclass(frozen=True)
class ExistingMapReport:
    """What came of a model of one's own; `report.json`."""

    n_images: int  # images with a pose
    n_points: int  # points of the model given
    triangulated_anew: bool  # whether the landmarks are new ones, from the images
    n_landmarks: int  # landmarks after the filter
    n_landmarks_removed: int  # points the filter removed
    has_descriptors: bool  # without them, ambiguity is unknown and nothing can be localized
    median_track_length: float  # observations of a landmark
    mean_reprojection_error_px: float  # mean over the landmarks
    cameras: list[dict[str, Any]]  # COLMAP's intrinsics
    scale: MapScale
    seed: int  # seed of COLMAP
    config: dict[str, Any]  # the configuration, as a dictionary
    seconds: dict[str, float]  # wall-clock time of each step


def map_existing(
    config: MapConfig,
    out_dir: str | Path = "map",
    work: str | Path = "photographs",
    seed: int = 0,
    workers: int = 1,
    device: str = "cpu",
    progress: bool = True,
    reconstruction: Any = None,
) -> ExistingMapReport:
    """Make a map of the COLMAP model in `config.existing.model`, which may have been read already.

    The result is what `build_map` makes: a COLMAP model with `landmarks.npz`, `cameras.npz` and `report.json`, which is
    also returned, beside it. Without images it is the model itself, rigs and all. With `config.photographs.images`, its
    images have the same poses and names, but ids from 1 and, as for a map of photographs, the reduced size; their
    keypoints are kept in `work`. A `MapWarning` says what is left out, and if metres or z up are doubtful.

    Raises MapError if the model, the database or an image cannot be used, nothing gives the scale asked for, or
    `out_dir` holds something that is not a map; ConfigError for settings that exclude one another.
    """
    settings = config.existing
    photographs = config.photographs
    out_dir = Path(out_dir)
    work = Path(work)
    clock = Clock()
    if settings.model is None:
        raise ConfigError("no model was named", fix="Set map.existing.model.")
    anew = photographs.images is not None
    if anew and settings.database is not None:
        fix = "Leave --database out to triangulate anew, or --images to keep the model's landmarks."
        raise ConfigError("images give new keypoints, so a database is of no use", value=settings.database, fix=fix)
    building.refuse_foreign_folder(out_dir)
    known = KnownScale.read(photographs.scale)
    with clock("read"):
        model = reconstruction or read_model(settings.model)
        colmap_poses(settings.model, model)  # raises if there is no image with a pose
        n_points = model.num_points3D()
        database = settings.database
        turned = True
    with atomic_folder(out_dir) as partial, WorkerPool(workers) as processes:
        worst_px = settings.max_reprojection_error_px
        if photographs.images is not None:
            with clock("extract"):
                work.mkdir(parents=True, exist_ok=True)
                names = list(registered_names(model).values())
                for name in names:
                    path_within(photographs.images, name, "the name of an image of the model")
                turned = _are_turned(model, photographs.images)
                how = (photographs.max_side_px, config.extractor, processes, device, progress, names, turned)
                features = photograph_features(photographs.images, work, *how)
            database = partial / DATABASE_FILE
            model = _triangulate(model, features, database, config, clock, seed, processes, progress)
            worst_px = worst_px or photographs.max_reprojection_error_px
        with clock("frame"):
            scale, to_world = _world(model, known, settings.level, photographs.images, turned, progress)
            if to_world is not None:
                to_world.transform_model(model)
        with clock("filter_and_write"):
            n_removed = 0
            if worst_px:
                if not all(point.has_error() for point in model.points3D.values()):
                    model.update_point_3d_errors()
                fix = "Raise map.existing.max_reprojection_error_px, or check the model's poses and intrinsics."
                n_removed = building.remove_inaccurate(model, worst_px, settings.model, fix)
            if anew:
                color_points(model, features.colors)
            write_model(model, partial)
        with clock("landmarks"):
            landmarks = load_colmap_landmarks(settings.model, database, device=device, reconstruction=model)
            landmarks.save(partial / LANDMARKS_FILE)
            poses = colmap_poses(settings.model, model)
            save_mapping_poses(poses, partial / CAMERAS_FILE)
        if anew and not config.keep_database:
            (partial / DATABASE_FILE).unlink()
        elif config.keep_database and settings.database is not None:
            is_features = settings.database.suffix.lower() in HDF5_SUFFIXES
            copy_file(settings.database, partial / (settings.database.name if is_features else DATABASE_FILE))
        report = ExistingMapReport(
            n_images=len(poses),
            n_points=n_points,
            triangulated_anew=anew,
            n_landmarks=len(landmarks),
            n_landmarks_removed=n_removed,
            has_descriptors=landmarks.descriptors is not None,
            median_track_length=float(np.median(landmarks.track_length)),
            mean_reprojection_error_px=float(landmarks.reprojection_error_px.mean()),
            cameras=[describe_intrinsics(camera) for _, camera in sorted(model.cameras.items())],
            scale=scale,
            seed=seed,
            config=asdict(config),
            seconds={**clock.seconds, "total": sum(clock.seconds.values())},
        )
        write_text(partial / REPORT_FILE, json.dumps(asdict(report), indent=2, default=str) + "\n")
    warn_of_frame(settings.model, landmarks.mapping_distance_m, poses)
    return report


def _world(
    model: Any, known: KnownScale, level: bool, images: Path | None, turned: bool, progress: bool
) -> tuple[MapScale, Similarity | None]:
    """The scale of a model, and the similarity to the world; None if it is to stay as it is."""
    rotation: Float = np.eye(3)
    if level:
        rotation = estimate_gravity(colmap_poses("", model)).rotation
    scale, to_world = find_scale(model, known, Similarity(1.0, rotation, np.zeros(3)), images, turned, progress)
    if scale.is_metric:
        return scale, to_world
    return MapScale("model"), to_world if level else None


def _triangulate(
    source: Any,
    features: PhotographFeatures,
    database: Path,
    config: MapConfig,
    clock: Clock,
    seed: int,
    processes: WorkerPool,
    progress: bool,
) -> Any:
    """New landmarks at the poses of a model, from keypoints of its images with a pose. Returns a new model."""
    with clock("pairs"):
        pairs = _pairs(source, PARTNERS, EXHAUSTIVE_UP_TO)
    model = _posed_model(source, features)
    steps = (config, clock, seed, processes, progress)
    model = triangulate_model(database, model, features.stored, features.colors, pairs, *steps)
    if not model.num_points3D():
        fix = "Check that these are the model's images, and that they overlap."
        raise MapError("the images give no landmark at the model's poses", path=config.photographs.images, fix=fix)
    return model


def _posed_model(source: Any, features: PhotographFeatures) -> Any:
    """A reconstruction of the same cameras, names and poses, of the size of the features; image i has the id i + 1."""
    import pycolmap

    model = pycolmap.Reconstruction()
    sizes = dict[int, list[int]]()
    images = [source.images[number] for number in registered_names(source)]
    for image, size in zip(images, features.sizes.tolist(), strict=True):
        if sizes.setdefault(image.camera_id, size) != size:
            value = (sizes[image.camera_id], size)
            fix = "Give the photographs that the model was made from."
            raise MapError("photographs of one camera have different sizes", path=image.name, value=value, fix=fix)
    for camera_id, (width, height) in sorted(sizes.items()):
        camera = pycolmap.Camera(source.cameras[camera_id].todict())
        camera.rescale(width, height)
        model.add_camera_with_trivial_rig(camera)
    for index, image in enumerate(images):
        posed = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=index + 1)
        model.add_image_with_trivial_frame(posed, image.cam_from_world())
    return model


def _pairs(source: Any, partners: int, exhaustive_up_to: int) -> NDArray[np.int64]:
    """Pairs (P, 2) of images with a pose to match, i < j, in the order of their ids: all of a few images.

    Of more, each with those that share most points of the model, or without points with the nearest that face much the
    same way.
    """
    poses = colmap_poses("", source)
    n = len(poses)
    if n <= exhaustive_up_to:
        return np.column_stack(np.triu_indices(n, 1)).astype(np.int64)
    if source.num_points3D():
        model = model_arrays(source)
        point = np.repeat(np.arange(len(model.points)), np.diff(model.observation_start))
        ones = np.ones(len(point), dtype=np.int32)
        sees = coo_array((ones, (model.observation_image, point)), shape=(n, len(model.points))).tocsr()
        sees.data[:] = 1  # a point observed twice in an image counts once
        shared = np.asarray((sees @ sees.T).toarray(), dtype=np.float64)
        np.fill_diagonal(shared, 0)
        return choose_pairs(shared, partners, 1.0)
    centers = camera_centers(poses)
    distance = np.linalg.norm(centers[:, None] - centers, axis=-1)
    nearness = 1 / (1 + distance) * (poses[:, 2, :3] @ poses[:, 2, :3].T > np.cos(np.radians(_FACING_DEG)))
    np.fill_diagonal(nearness, 0)
    return choose_pairs(nearness, 2 * partners, 0.0)


def _are_turned(model: Any, folder: Path) -> bool:
    """Whether the model's images are its photographs turned upright by EXIF; else they are as stored.

    COLMAP's versions differ in this. Raises MapError if one is missing, unreadable, or has neither proportions.
    """
    images = [model.images[number] for number in registered_names(model)]
    misfits: list[tuple[str, tuple[int, int], tuple[int, int]]] = []
    for turned in (True, False):
        for image in images:
            camera = model.cameras[image.camera_id]
            (width, height) = _size(folder / image.name, turned)
            if abs(width * camera.height / (height * camera.width) - 1) > _PROPORTIONS:
                misfits.append((image.name, (width, height), (camera.width, camera.height)))
                break
        else:
            return turned
    name, size, expected = misfits[0]
    problem = f"this photograph has other proportions than its camera in the model, {expected[0]} x {expected[1]}"
    raise MapError(problem, path=folder / name, value=size, fix="Give the photographs that the model was made from.")


def _size(path: Path, turned: bool) -> tuple[int, int]:
    """Width and height of a photograph, turned upright as the EXIF orientation says, or as stored."""
    from PIL import Image

    try:
        width, height = image_size(path)
        with Image.open(path) as photograph:
            is_aside = turned and photograph.getexif().get(_ORIENTATION, 1) in _ASIDE
    except FileNotFoundError as error:
        fix = "Give the folder that the names of the model's images are relative to."
        raise MapError("an image of the model is missing", path=path, fix=fix) from error
    except (OSError, ValueError) as error:
        raise MapError(f"cannot read this photograph: {error}", path=path, fix="Copy it again.") from error
    return (height, width) if is_aside else (width, height)
