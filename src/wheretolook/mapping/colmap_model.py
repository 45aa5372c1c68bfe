"""Reads COLMAP models into arrays, with errors that say what is wrong with a file, and stores their images' poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.geometry.camera import Camera, cameras_by_id, mean_focal_px, only_camera
from wheretolook.geometry.local_origin import local_origin
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.mapping.colmap_files import (
    REBUILD,
    blame_binary,
    blame_text,
    check_binary,
    check_text,
    check_text_count,
    contradicting,
    point_heads,
    point_starts,
    track_elements,
)
from wheretolook.utils.colmap import quiet_colmap
from wheretolook.utils.errors import MapError, StorageError
from wheretolook.utils.files import STORAGE_FIX, storage_errors, temporary_folder
from wheretolook.utils.npz_files import load_npz, save_npz

CAMERAS_FILE = "cameras.npz"  # lies beside the landmarks, small enough to travel without the COLMAP model
MODEL_FILES = ("cameras", "images", "points3D")
_LARGE_BYTES = 500e6  # of a model that takes so long to read that a bar shows how far it is


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
    """Whether a folder holds a binary model, ".bin", or one of text, ".txt". MapError if it holds none, or not all."""
    folder = Path(model_dir)
    if not folder.is_dir():
        fix = "Give the folder that holds cameras.bin, images.bin and points3D.bin."
        raise MapError("there is no such folder", path=folder, fix=fix)
    suffix = next((s for s in (".bin", ".txt") if any((folder / (n + s)).is_file() for n in MODEL_FILES)), None)
    if suffix is None:
        inside = [path.parent for path in sorted(folder.glob("**/images.*")) if holds_model(path.parent)][:5]
        fix = f"Give the folder that holds cameras, images and points3D (.bin or .txt){_listed(inside)}."
        raise MapError("no COLMAP model here", path=folder, fix=fix)
    for name in MODEL_FILES:
        if not (folder / (name + suffix)).is_file():
            raise MapError("a file of the COLMAP model is missing", path=folder / (name + suffix), fix=REBUILD)
    return suffix


def read_model(model_dir: str | Path) -> Any:
    """Read a COLMAP model as a `pycolmap.Reconstruction`, binary or text, with or without rigs and frames (3.12).

    Raises MapError if the folder or a file is missing, truncated or corrupt, or holds a camera, pose or point that is
    not finite or that no model can have; it names the file.
    """
    folder = Path(model_dir)
    suffix = model_suffix(model_dir)
    import pycolmap

    n_bytes = sum((folder / (name + suffix)).stat().st_size for name in MODEL_FILES)
    bar = tqdm(total=2, desc=f"model of {n_bytes / 1e9:.1f} GB: read", unit="step", disable=n_bytes < _LARGE_BYTES)
    reconstruction = pycolmap.Reconstruction()
    with bar, quiet_colmap():
        (check_text(folder) if suffix == ".txt" else check_binary(folder, folder))
        bar.update()
        try:
            (reconstruction.read_binary if suffix == ".bin" else reconstruction.read_text)(str(folder))
        except (ValueError, IndexError, RuntimeError, MemoryError, KeyError) as error:
            (blame_text if suffix == ".txt" else blame_binary)(folder)
            name = contradicting(error)
            path = folder / f"{name}{suffix}" if name else folder
            raise MapError(f"pycolmap cannot read the model: {error}", path=path, fix=REBUILD) from error
        bar.update()
    if suffix == ".txt":
        found = (reconstruction.num_cameras(), reconstruction.num_images(), reconstruction.num_points3D())
        for name, number in zip(MODEL_FILES, found, strict=True):
            check_text_count(folder / f"{name}.txt", number)
        with temporary_folder() as copy:
            reconstruction.write_binary(copy)
            check_binary(copy, folder, suffix)
    return reconstruction


def write_model(reconstruction: Any, folder: Path) -> None:
    """Write a `pycolmap.Reconstruction` as binary files into a folder, made if missing.

    pycolmap does not notice a full disk, so that what was written is checked. Raises StorageError, which names the file
    that is not whole.
    """
    with storage_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        reconstruction.write_binary(str(folder))
        check_binary(folder, folder)
    except (MapError, RuntimeError, ValueError) as error:
        path = (error.path if isinstance(error, MapError) else None) or folder
        problem = f"cannot be written whole: is the disk full? ({getattr(error, 'problem', error)})"
        raise StorageError(problem, path=path, fix=STORAGE_FIX) from error


def model_arrays(reconstruction: Any) -> ModelArrays:
    """Arrays of a `pycolmap.Reconstruction`. Errors it does not hold yet are computed from the observations.

    Raises MapError if a track names an image that has no pose.
    """
    stored = _stored_points(reconstruction)
    if not (stored.errors_px[stored.lengths > 0] >= 0).all():  # COLMAP writes -1 for an error that is not known
        reconstruction.update_point_3d_errors()
        stored = _stored_points(reconstruction)
    image_ids = np.array(sorted(i for i, image in reconstruction.images.items() if image.has_pose), dtype=np.int64)
    images = [reconstruction.images[i] for i in image_ids]
    if not np.isin(stored.elements[:, 0], image_ids).all():
        raise MapError("points were observed by images without a pose", fix=REBUILD)
    return ModelArrays(
        point_ids=stored.ids,
        points=stored.points,
        errors_px=stored.errors_px,
        image_ids=image_ids,
        image_names=[image.name for image in images],
        image_centers=np.array([image.projection_center() for image in images], dtype=np.float64).reshape(-1, 3),
        image_focal_px=np.array([mean_focal_px(reconstruction.cameras[image.camera_id]) for image in images]),
        observation_start=np.concatenate([[0], np.cumsum(stored.lengths)]).astype(np.int64),
        observation_image=np.searchsorted(image_ids, stored.elements[:, 0]),
        observation_keypoint=stored.elements[:, 1],
    )


def colmap_poses(model_dir: str | Path, reconstruction: Any = None) -> Float:
    """Poses cam_from_world (M, 3, 4) float64 of the images of a COLMAP model that have one, in the order of their ids.

    The model is read from its folder, as by `read_model`, unless it is given. MapError if no image has a pose.
    """
    images = (reconstruction or read_model(model_dir)).images
    posed = [images[number] for number in sorted(images) if images[number].has_pose]
    if not posed:
        raise MapError("the map has no images", path=model_dir, value=0, fix="Run the map stage again.")
    return np.stack([image.cam_from_world().matrix() for image in posed])


def camera_of_model(reconstruction: Any, path: Path, camera_id: int | None = None) -> Camera:
    """A camera of a pycolmap model: that of a camera_id, or the only one. MapError, naming the model, if none is it."""
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


def describe_intrinsics(camera: Any) -> dict[str, Any]:
    """Model, size and parameters of a pycolmap camera, as values of JSON."""
    size = {"model": camera.model_name, "width": camera.width, "height": camera.height}
    return {**size, "params": [float(value) for value in camera.params]}


def holds_model(folder: Path) -> bool:
    """Whether a folder holds a COLMAP model, binary or text."""
    return any(all((folder / (name + suffix)).is_file() for name in MODEL_FILES) for suffix in (".bin", ".txt"))


def save_mapping_poses(cam_from_world: Float, path: str | Path) -> None:
    """Write poses (M, 3, 4) as an NPZ file, see `compact_poses`, atomically. The same poses give the same bytes."""
    save_npz(Path(path), {"cam_from_world": compact_poses(cam_from_world)})


def compact_poses(cam_from_world: Float) -> Float:
    """Poses (M, 3, 4) in single precision; in double where single is too coarse, far from the world's origin."""
    near = not local_origin(camera_centers(cam_from_world)).any()
    return np.asarray(cam_from_world, dtype=np.float32 if near else np.float64)


def load_mapping_poses(path: str | Path) -> Float:
    """Read what `save_mapping_poses` wrote, (M, 3, 4). MapError if the file is missing, damaged or another."""
    path = Path(path)
    fix = "Run the map stage again, or remove it to read the COLMAP model beside it instead."
    if not path.is_file():
        raise MapError("there is no file of the mapping images' poses", path=path, fix="Run the map stage again.")
    try:
        poses = load_npz(path)["cam_from_world"]
    except (ValueError, KeyError) as error:
        raise MapError(f"cannot read the mapping images' poses: {error}", path=path, fix=fix) from error
    shape = poses.shape if poses.dtype.kind == "f" else ()
    if len(shape) != 3 or shape[1:] != (3, 4) or not len(poses) or not np.isfinite(poses).all():
        raise MapError("these are no poses of mapping images", path=path, value=poses.shape, fix=fix)
    return np.asarray(poses)


def _listed(folders: list[Path]) -> str:
    return f", such as {', '.join(map(str, folders))}" if folders else ""


@dataclass(frozen=True, eq=False)
class _StoredPoints:
    """What points3D.bin holds, sorted by id."""

    ids: NDArray[np.int64]  # (P,)
    points: NDArray[np.float64]  # (P, 3)
    errors_px: NDArray[np.float64]  # (P,)
    lengths: NDArray[np.int64]  # (P,) of the tracks
    elements: NDArray[np.int64]  # (O, 2) image id and index of the keypoint, track after track


def _stored_points(reconstruction: Any) -> _StoredPoints:
    """Points and tracks of a reconstruction, by way of a file: asked for one by one, 500,000 take a quarter minute."""
    with temporary_folder() as folder:
        reconstruction.write_binary(folder)
        data = np.fromfile(folder / "points3D.bin", dtype=np.uint8)
    starts = point_starts(data.tobytes())
    if starts[-1] < 0:  # pycolmap does not notice a full disk
        path = folder / "points3D.bin"
        raise StorageError("cannot be written whole: is the disk full?", path=path, fix=STORAGE_FIX)
    heads = point_heads(data, starts)
    elements = track_elements(data, starts).astype(np.int64)
    lengths = heads["n"].astype(np.int64)
    order = np.argsort(heads["id"])
    ends = np.cumsum(lengths)
    rows = np.repeat((ends - lengths)[order] - np.cumsum(lengths[order]) + lengths[order], lengths[order])
    elements = elements[rows + np.arange(len(rows))]
    heads = heads[order]
    return _StoredPoints(heads["id"].astype(np.int64), heads["xyz"], heads["error"], lengths[order], elements)
