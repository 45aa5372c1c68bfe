"""Read and write COLMAP models, and convert them to arrays of points, observations and poses."""

from __future__ import annotations

import warnings
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.geometry.camera import Camera, cameras_by_id, mean_focal_px, only_camera
from wheretolook.geometry.local_origin import local_origin
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.mapping.colmap_files import (
    REBUILD,
    check_binary,
    check_cameras_and_images,
    check_coordinates,
    check_text_complete,
    model_error,
    read_points,
    without_marks,
)
from wheretolook.utils.colmap import quiet_colmap
from wheretolook.utils.errors import MapError, MapWarning, StorageError
from wheretolook.utils.files import STORAGE_FIX, storage_errors, temporary_folder
from wheretolook.utils.npz_files import load_npz, save_npz

if TYPE_CHECKING:
    from scipy.sparse import csr_array

CAMERAS_FILE = "cameras.npz"  # next to the landmarks; small enough to be shipped without the COLMAP model
MODEL_FILES = ("cameras", "images", "points3D")
_SUFFIXES = (".bin", ".txt")
_LARGE_BYTES = 500e6  # of a model from which on reading it shows a progress bar


@dataclass(frozen=True, eq=False)
class ModelArrays:
    """A reconstruction as arrays. Points are sorted by id, observations by point and then as in the point's track."""

    point_ids: NDArray[np.int64]  # (P,)
    points: NDArray[np.float64]  # (P, 3) world
    errors_px: NDArray[np.float64]  # (P,) mean reprojection error
    image_ids: NDArray[np.int64]  # (I,) ascending
    image_names: list[str]  # I names
    image_centers: NDArray[np.float64]  # (I, 3) camera centres in the world
    image_focal_px: NDArray[np.float64]  # (I,) mean focal length of the image's camera
    observation_start: NDArray[np.int64]  # (P + 1,); observations start[i] to start[i + 1] belong to point i
    observation_image: NDArray[np.int64]  # (O,) row in `image_ids`
    observation_keypoint: NDArray[np.int64]  # (O,) index of the keypoint in its image


def model_suffix(model_dir: str | Path) -> str:
    """Suffix of the model's files in a folder: ".bin" or ".txt". Raises MapError if the model is missing or incomplete."""
    folder = Path(model_dir)
    suffix = next((s for s in _SUFFIXES if any((folder / (n + s)).is_file() for n in MODEL_FILES)), None)
    if suffix is None:
        inside = [str(path.parent) for path in sorted(folder.glob("**/images.*")) if holds_model(path.parent)][:5]
        examples = f", such as {', '.join(inside)}" if inside else ""
        fix = f"Give the folder that holds cameras, images and points3D (.bin or .txt){examples}."
        raise MapError("no COLMAP model here", path=folder, fix=fix)
    for name in MODEL_FILES:
        if not (folder / (name + suffix)).is_file():
            raise MapError("a file of the COLMAP model is missing", path=folder / (name + suffix), fix=REBUILD)
    return suffix


def read_model(model_dir: str | Path) -> Any:
    """Read a COLMAP model as a `pycolmap.Reconstruction`, binary or text, with or without rigs and frames (3.12).

    Raises MapError, which names the file, if the folder or a file is missing, truncated or corrupt, or holds an
    impossible camera, pose or point.
    """
    folder = Path(model_dir)
    suffix = model_suffix(folder)
    import pycolmap

    n_bytes = sum((folder / (name + suffix)).stat().st_size for name in MODEL_FILES)
    bar = tqdm(total=2, desc=f"model of {n_bytes / 1e9:.1f} GB: read", unit="step", disable=n_bytes < _LARGE_BYTES)
    model = pycolmap.Reconstruction()
    with bar, quiet_colmap():
        if suffix == ".bin":
            check_binary(folder)
        bar.update()
        try:
            with without_marks(folder, suffix) as readable:
                (model.read_binary if suffix == ".bin" else model.read_text)(str(readable))
            check_cameras_and_images(model, folder, suffix)
        except (ValueError, LookupError, RuntimeError, MemoryError) as error:
            raise model_error(error, folder, suffix) from error
        bar.update()
    if suffix == ".txt":
        numbers = (model.num_cameras(), model.num_images(), model.num_points3D())
        for name, number in zip(MODEL_FILES, numbers, strict=True):
            check_text_complete(folder / f"{name}.txt", number)
        check_coordinates(_points_and_tracks(model)[0], folder / "points3D.txt")
    _warn_of_larger(folder, model.num_images())
    return model


def _warn_of_larger(folder: Path, n_images: int) -> None:
    """Warn of a model of more images among those of one reconstruction: sparse/N of COLMAP, models/N of hloc."""
    others = [*folder.glob("models/*/images.bin")]
    if folder.name.isdigit():
        others += folder.parent.glob("[0-9]*/images.bin")
    for path in others:
        with suppress(OSError), path.open("rb") as file:
            n_others = int.from_bytes(file.read(8), "little")  # as COLMAP begins the file
            if n_others > n_images:
                text = f"{folder} has {n_images} images, the model in {path.parent} has {n_others:,}: is that the map?"
                warnings.warn(text, MapWarning, stacklevel=3)


def write_model(reconstruction: Any, folder: Path) -> None:
    """Write a `pycolmap.Reconstruction` as binary files into a folder, which is made if missing.

    pycolmap does not notice a full disk, so the sizes of the files are checked. Raises StorageError that names the
    incomplete file.
    """
    with storage_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        reconstruction.write_binary(str(folder))
        check_binary(folder)
    except (MapError, RuntimeError, ValueError) as error:
        path = (error.path if isinstance(error, MapError) else None) or folder
        problem = f"cannot be written completely: is the disk full? ({getattr(error, 'problem', error)})"
        raise StorageError(problem, path=path, fix=STORAGE_FIX) from error


def model_arrays(reconstruction: Any) -> ModelArrays:
    """Convert a `pycolmap.Reconstruction` to arrays. Unknown reprojection errors are computed from the observations.

    Raises MapError if a track names an image without a pose.
    """
    points, elements = _points_and_tracks(reconstruction)
    if not (points["error"][points["n"] > 0] >= 0).all():  # COLMAP writes -1 for an unknown error
        reconstruction.update_point_3d_errors()
        points, elements = _points_and_tracks(reconstruction)
    image_ids = np.array(sorted(i for i, image in reconstruction.images.items() if image.has_pose), dtype=np.int64)
    images = [reconstruction.images[i] for i in image_ids]
    if not np.isin(elements[:, 0], image_ids).all():
        raise MapError("points were observed by images without a pose", fix=REBUILD)
    return ModelArrays(
        point_ids=points["id"].astype(np.int64),
        points=points["xyz"],
        errors_px=points["error"],
        image_ids=image_ids,
        image_names=[image.name for image in images],
        image_centers=np.array([image.projection_center() for image in images], dtype=np.float64).reshape(-1, 3),
        image_focal_px=np.array([mean_focal_px(reconstruction.cameras[image.camera_id]) for image in images]),
        observation_start=np.concatenate([[0], np.cumsum(points["n"])]).astype(np.int64),
        observation_image=np.searchsorted(image_ids, elements[:, 0]),
        observation_keypoint=elements[:, 1].astype(np.int64),
    )


def select_points(model: ModelArrays, keep: NDArray[np.bool_]) -> ModelArrays:
    """Select the points (P,) of a model for which `keep` is true, with their observations."""
    lengths = np.diff(model.observation_start)
    rows = np.repeat(keep, lengths)
    return replace(
        model,
        point_ids=model.point_ids[keep],
        points=model.points[keep],
        errors_px=model.errors_px[keep],
        observation_start=np.concatenate([[0], np.cumsum(lengths[keep])]),
        observation_image=model.observation_image[rows],
        observation_keypoint=model.observation_keypoint[rows],
    )


def observation_matrix(model: ModelArrays, group: NDArray[np.integer[Any]] | None = None) -> csr_array:
    """Which images, or groups (I,) of images, observe which points: a sparse matrix (I or number of groups, P) of ones.

    Its product with its own transpose counts the points that two images share.
    """
    point = np.repeat(np.arange(len(model.points)), np.diff(model.observation_start))
    rows = model.observation_image if group is None else group[model.observation_image]
    n_rows = len(model.image_ids) if group is None else int(group.max()) + 1
    from scipy.sparse import coo_array

    matrix = coo_array(
        (np.ones(len(point), dtype=np.float32), (rows, point)), shape=(n_rows, len(model.points))
    ).tocsr()
    matrix.data[:] = 1  # a point observed twice counts once
    return matrix


def colmap_poses(model_dir: str | Path, reconstruction: Any = None) -> Float:
    """Poses cam_from_world (M, 3, 4) float64 of a COLMAP model's images with a pose, in the order of their ids.

    Reads the model from its folder unless it is passed. Raises MapError if no image has a pose.
    """
    images = (reconstruction or read_model(model_dir)).images
    posed = [images[number] for number in sorted(images) if images[number].has_pose]
    if not posed:
        raise MapError("the map has no images", path=model_dir, value=0, fix="Run the map stage again.")
    return np.stack([image.cam_from_world().matrix() for image in posed])


def camera_of_model(reconstruction: Any, path: Path, camera_id: int | None = None) -> Camera:
    """The camera of a pycolmap model with an id, or its only camera. Raises MapError, naming the model, if there is none."""
    known = cameras_by_id(reconstruction.cameras, path)
    if camera_id is None:
        return only_camera(known, path)
    if camera_id not in known:
        fix = f"It has {', '.join(map(str, known))}."
        raise MapError("the model has no such camera", path=path, value=camera_id, fix=fix)
    return known[camera_id]


def registered_names(reconstruction: Any) -> dict[int, str]:
    """Names of the images with a pose, by id, in the order of ids."""
    return {number: image.name for number, image in sorted(reconstruction.images.items()) if image.has_pose}


def describe_cameras(reconstruction: Any) -> list[dict[str, Any]]:
    """Model, size and parameters of each camera of a `pycolmap.Reconstruction`, as values of JSON."""
    cameras = [camera for _, camera in sorted(reconstruction.cameras.items())]
    return [{"model": c.model_name, "width": c.width, "height": c.height, "params": c.params.tolist()} for c in cameras]


def holds_model(folder: Path) -> bool:
    """Whether a folder holds a COLMAP model, binary or text."""
    return any(all((folder / (name + suffix)).is_file() for name in MODEL_FILES) for suffix in _SUFFIXES)


def save_mapping_poses(cam_from_world: Float, path: str | Path) -> None:
    """Write poses (M, 3, 4) as an NPZ file, see `compact_poses`, atomically. The same poses give the same bytes."""
    save_npz(Path(path), {"cam_from_world": compact_poses(cam_from_world)})


def cameras_of_images(model_dir: Path, reconstruction: Any) -> tuple[Camera, ...]:
    """Return the cameras (M,) of the images whose poses `colmap_poses` returns."""
    cameras = cameras_by_id(reconstruction.cameras, model_dir)
    return tuple(cameras[image.camera_id] for _, image in sorted(reconstruction.images.items()) if image.has_pose)


def compact_poses(cam_from_world: Float) -> Float:
    """Cast poses (M, 3, 4) to single precision, or to double if they are far from the world's origin."""
    near = not local_origin(camera_centers(cam_from_world)).any()
    return np.asarray(cam_from_world, dtype=np.float32 if near else np.float64)


def load_mapping_poses(path: str | Path) -> Float:
    """Read the poses (M, 3, 4) that `save_mapping_poses` wrote. Raises MapError if the file is missing or damaged."""
    try:
        return load_npz(Path(path))["cam_from_world"]
    except (ValueError, KeyError) as error:
        fix = "Run the map stage again, or remove the file to use the COLMAP model next to it."
        raise MapError(f"cannot read the mapping images' poses: {error}", path=path, fix=fix) from error


def _points_and_tracks(reconstruction: Any) -> tuple[NDArray[Any], NDArray[np.uint32]]:
    """Points and tracks of a reconstruction as `read_points` gives them."""
    with temporary_folder() as folder:
        reconstruction.write_binary(folder)
        return read_points(folder / "points3D.bin")
