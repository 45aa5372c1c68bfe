"""Make a map from an existing COLMAP model: as it is, rotated and scaled, or triangulated again at its poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from wheretolook.geometry.poses import camera_centers
from wheretolook.mapping.colmap_model import (
    colmap_poses,
    describe_cameras,
    model_arrays,
    observation_matrix,
    read_model,
    registered_names,
)
from wheretolook.mapping.config import EXHAUSTIVE_UP_TO, PARTNERS, ImportConfig
from wheretolook.mapping.georeference import MapScale, MarkedPhotographs, check_tables
from wheretolook.mapping.map import reads_upright
from wheretolook.mapping.map_folder import DATABASE_FILE, MapDraft, MapReport, MapRun, finish_map, replacing_map
from wheretolook.mapping.map_frame import IDENTITY, find_frame
from wheretolook.mapping.photograph_map import PhotographFeatures, photograph_features
from wheretolook.mapping.photographs import quarters_upright, read_photograph, reduce_photograph
from wheretolook.mapping.triangulation import choose_pairs, triangulate_model
from wheretolook.utils.errors import ConfigError, MapError
from wheretolook.utils.files import image_size, path_within


@dataclass(frozen=True)
class ExistingMapReport(MapReport):
    """Properties of a map from an existing model; `report.json`."""

    n_points: int  # points of the existing model
    retriangulated: bool  # whether the landmarks were triangulated again, from the images
    has_descriptors: bool  # without them, ambiguity is unknown and nothing can be localized
    cameras: list[dict[str, Any]]  # COLMAP's intrinsics
    frame: dict[str, Any]  # the model's own, see `MapFrame.record`
    scale: MapScale
    upright: bool = False  # whether its images are the photographs turned upright by EXIF; else they are as stored


def map_existing(
    config: ImportConfig,
    out_dir: str | Path = "map",
    work: Path = Path("photographs"),
    seed: int = 0,
    workers: int = 1,
    device: str = "cpu",
    progress: bool = True,
    reconstruction: Any = None,
) -> ExistingMapReport:
    """Make a map of the COLMAP model in `config.model`; `reconstruction` is that model, if read already.

    Writes what `build_map` writes. Without images it is the model itself, with its rigs. With
    `config.images`, its images have the same poses and names, but ids from 1 and the reduced size; their
    keypoints are cached in `work`. A `MapWarning` reports omitted points, and doubts about metres or z up.
    Raises MapError if the model, the database or an image cannot be used, nothing gives the requested scale, or
    `out_dir` holds something else; ConfigError for settings that exclude one another.
    """
    images = config.images
    if images is not None and config.database is not None:
        fix = "Leave --database out to triangulate again, or --images to keep the model's landmarks."
        raise ConfigError("images give new keypoints, which a database does not describe", fix=fix)
    check_tables(config.scale, config.frame)
    with replacing_map(config, out_dir, seed, workers, device, progress) as (folder, run):
        with run.clock("read"):
            model = reconstruction or read_model(config.model)
            n_points = model.num_points3D()
        database = config.database
        turned = reads_upright(config.model)
        if images is not None:
            turned = are_turned(model, images)
            database = folder / DATABASE_FILE
            with run.clock("extract"):
                names = list(registered_names(model).values())
                features = photograph_features(images, work, run, config.max_side_px, names, turned)
            model = triangulate_at_poses(model, images, features, database, run)
        with run.clock("frame"):
            marked = MarkedPhotographs(config.scale, images, turned, progress)
            frame = find_frame(config.model, model, config.frame, photographs=marked)
            frame.world_from_map.transform_model(model)
        if config.limit_px and not all(point.has_error() for point in model.points3D.values()):
            model.update_point_3d_errors()
        fix = "Raise `ImportConfig.max_reprojection_error_px`, or check the model's poses and intrinsics."
        draft = MapDraft(model, config.model, config.limit_px, fix, database, search_device=device)
        landmarks, fields = finish_map(draft, folder, run)
        poses = colmap_poses(config.model, model)
        report = ExistingMapReport(
            n_images=len(poses),
            **fields,
            seconds=run.clock.with_total(),
            n_points=n_points,
            retriangulated=images is not None,
            has_descriptors=landmarks.descriptors is not None,
            cameras=describe_cameras(model),
            frame=frame.record(),
            scale=frame.scale,
            upright=turned,
        )
        report.save(folder)
    IDENTITY.warn(config.model, landmarks.mapping_distance_m, poses)
    return report


def triangulate_at_poses(source: Any, images: Path, features: PhotographFeatures, database: Path, run: MapRun) -> Any:
    """Triangulate new landmarks at the poses of a model, from keypoints of its images. Returns a new model."""
    with run.clock("pairs"):
        pairs = _pairs(source)
    model = triangulate_model(database, _posed_model(source, features), features.stored, features.colors, pairs, run)
    if not model.num_points3D():
        fix = "Check that these are the model's images, and that they overlap."
        raise MapError("the images give no landmark at the model's poses", path=images, fix=fix)
    return model


def _posed_model(source: Any, features: PhotographFeatures) -> Any:
    """A reconstruction with the same cameras, names and poses, at the size of the features; image i has the id i + 1."""
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


def _pairs(source: Any) -> NDArray[np.int64]:
    """Pairs (P, 2) of images with a pose to match, i < j, in the order of their ids: all pairs of a few images.

    Of more, each with those that share most points of the model, or without points with the nearest that face much the
    same way.
    """
    poses = colmap_poses("", source)
    if len(poses) <= EXHAUSTIVE_UP_TO:
        return np.column_stack(np.triu_indices(len(poses), 1)).astype(np.int64)
    if source.num_points3D():
        observed = observation_matrix(model_arrays(source))
        shared = (observed @ observed.T).toarray().astype(np.float64)
        np.fill_diagonal(shared, 0)
        return choose_pairs(shared, PARTNERS, 1.0)
    centers = camera_centers(poses)
    distance = np.linalg.norm(centers[:, None] - centers, axis=-1)
    nearness = 1 / (1 + distance) * (poses[:, 2, :3] @ poses[:, 2, :3].T > np.cos(np.radians(60)))
    np.fill_diagonal(nearness, 0)
    return choose_pairs(nearness, 2 * PARTNERS, 0.0)


def are_turned(model: Any, folder: Path) -> bool:
    """Whether the model's images are its photographs turned upright by EXIF; else they are as stored.

    Decided by the sizes of the cameras, and where these fit both readings by the model's keypoints (`_keypoints_found`).
    Raises MapError if a photograph is missing or unreadable, or fits its camera in neither way.
    """
    names = registered_names(model)
    paths = {number: path_within(folder, name, "the name of an image of the model") for number, name in names.items()}
    sizes = {number: _size(path) for number, path in paths.items()}
    quarters = {number: quarters_upright(path) for number, path in paths.items()}
    misfits = {}
    for turned in (False, True):
        for number, size in sizes.items():
            width, height = size[::-1] if turned and quarters[number] in (1, 3) else size
            camera = model.cameras[model.images[number].camera_id]
            if abs(width * camera.height / (height * camera.width) - 1) > 0.01:
                misfits[turned] = number, (width, height), (camera.width, camera.height)
                break
    if len(misfits) == 2:
        number, size, expected = misfits[True]
        problem = f"the photograph's proportions differ from those of its camera in the model, {expected}"
        raise MapError(
            problem, path=paths[number], value=size, fix="Give the photographs that the model was made from."
        )
    if misfits:
        return False in misfits
    flagged = [model.images[number] for number, turns in quarters.items() if turns]
    flagged = sorted(flagged, key=lambda image: -image.num_points3D)[:3]
    found = [
        sum(_keypoints_found(image, paths[image.image_id], turned) for image in flagged) for turned in (False, True)
    ]
    return found[1] > 1.5 * found[0]


def _keypoints_found(image: Any, path: Path, turned: bool) -> int:
    """Number of the keypoints of a model's image that its photograph has, too, stored or turned, within 1.5 px.

    Most detectors find the same corners as SIFT, which is asked for 1,000.
    """
    import cv2  # of an extra

    keypoints = np.array([point.xy for point in image.points2D if point.has_point3D()]).reshape(-1, 2)
    rgb = read_photograph(path, turned)
    rgb = reduce_photograph(rgb, max(image.camera.width, image.camera.height))
    detected = cv2.SIFT.create(nfeatures=1000).detect(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
    if not detected or not len(keypoints):
        return 0
    distance, _ = cKDTree([np.add(one.pt, 0.5) for one in detected]).query(keypoints, distance_upper_bound=1.5)
    return int(np.isfinite(distance).sum())


def _size(path: Path) -> tuple[int, int]:
    """Width and height of a photograph as stored."""
    try:
        return image_size(path)
    except (OSError, ValueError) as error:
        fix = "Give the folder that the names of the model's images are relative to."
        raise MapError(f"cannot read an image of the model: {error}", path=path, fix=fix) from error
