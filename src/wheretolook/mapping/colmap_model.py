"""Reading COLMAP models into arrays, with errors that say what is wrong with a file."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.utils.colmap import quiet_colmap
from wheretolook.utils.errors import MapError

MODEL_FILES = ("cameras", "images", "points3D")
_REBUILD = "Copy or build the model again."
# Bytes an entry needs at least: an empty name, no 2D points, no track, a rig of one sensor, a frame of one image.
_LEAST_BYTES = {"images.bin": 73, "rigs.bin": 8, "frames.bin": 68}
_POINT_BYTES = 51  # id, position, colour, error, track length; the track's elements follow


@dataclass(frozen=True, eq=False)
class ModelArrays:
    """A reconstruction as arrays. Points are sorted by id, observations by point and then as in the point's track.

    Attributes:
        point_ids: (P,) int64.
        points: (P, 3) float64, world.
        errors_px: (P,) float64, mean reprojection error.
        image_ids: (I,) int64, ascending.
        image_names: I names.
        image_centers: (I, 3) float64, camera centres in the world.
        observation_start: (P + 1,) int64; observations start[i] to start[i + 1] belong to point i.
        observation_image: (O,) int64, row in `image_ids`.
        observation_keypoint: (O,) int64, index of the keypoint in its image.
    """

    point_ids: NDArray[np.int64]
    points: NDArray[np.float64]
    errors_px: NDArray[np.float64]
    image_ids: NDArray[np.int64]
    image_names: list[str]
    image_centers: NDArray[np.float64]
    observation_start: NDArray[np.int64]
    observation_image: NDArray[np.int64]
    observation_keypoint: NDArray[np.int64]


def read_model(model_dir: str | Path) -> Any:
    """Read a COLMAP model, binary or text, with or without the rigs and frames of COLMAP 3.12 and later.

    Returns:
        A `pycolmap.Reconstruction`.

    Raises:
        MapError: the folder or a file is missing, or a file is truncated or corrupt.
    """
    import pycolmap

    folder = Path(model_dir)
    if not folder.is_dir():
        raise MapError(
            "there is no such folder",
            path=folder,
            fix="Give the folder that holds cameras.bin, images.bin and points3D.bin.",
        )
    suffix = next((s for s in (".bin", ".txt") if any((folder / (n + s)).is_file() for n in MODEL_FILES)), None)
    if suffix is None:
        raise MapError(
            "no COLMAP model here",
            path=folder,
            fix="Give the folder that holds cameras, images and points3D (.bin or .txt).",
        )
    for name in MODEL_FILES:
        if not (folder / (name + suffix)).is_file():
            raise MapError("a file of the COLMAP model is missing", path=folder / (name + suffix), fix=_REBUILD)
    if suffix == ".bin":
        # pycolmap takes a count from whatever is there and may then read for ever.
        for name, least in _LEAST_BYTES.items():
            _check_count(folder / name, least)
        _check_points(folder / "points3D.bin")
    reconstruction = pycolmap.Reconstruction()
    try:
        with quiet_colmap():
            (reconstruction.read_binary if suffix == ".bin" else reconstruction.read_text)(str(folder))
    except (ValueError, IndexError, RuntimeError, MemoryError, KeyError) as error:
        raise MapError(f"pycolmap cannot read the model: {error}", path=folder, fix=_REBUILD) from error
    if suffix == ".bin":
        images, cameras = reconstruction.images.values(), reconstruction.cameras.values()
        _check_size(folder / "cameras.bin", 8 + sum(24 + 8 * len(c.params) for c in cameras))
        _check_size(folder / "images.bin", 8 + sum(73 + len(i.name.encode()) + 24 * i.num_points2D() for i in images))
    return reconstruction


def model_arrays(reconstruction: Any) -> ModelArrays:
    """Arrays of a `pycolmap.Reconstruction`. Errors it does not hold yet are computed from the observations.

    Raises:
        MapError: a track names an image that has no pose.
    """
    points = reconstruction.points3D
    point_ids = np.array(sorted(points), dtype=np.int64)
    ordered = [points[i] for i in point_ids]
    if not all(p.has_error() for p in ordered):
        reconstruction.update_point_3d_errors()
    image_ids = np.array(sorted(i for i, image in reconstruction.images.items() if image.has_pose), dtype=np.int64)
    images = [reconstruction.images[i] for i in image_ids]
    tracks = [p.track.elements for p in ordered]
    observations = np.array([(e.image_id, e.point2D_idx) for track in tracks for e in track], dtype=np.int64).reshape(
        -1, 2
    )
    if not np.isin(observations[:, 0], image_ids).all():
        raise MapError("points were observed by images without a pose", fix=_REBUILD)
    return ModelArrays(
        point_ids=point_ids,
        points=np.array([p.xyz for p in ordered], dtype=np.float64).reshape(-1, 3),
        errors_px=np.array([p.error for p in ordered], dtype=np.float64),
        image_ids=image_ids,
        image_names=[image.name for image in images],
        image_centers=np.array([image.projection_center() for image in images], dtype=np.float64).reshape(-1, 3),
        observation_start=np.concatenate([[0], np.cumsum([len(t) for t in tracks], dtype=np.int64)]).astype(np.int64),
        observation_image=np.searchsorted(image_ids, observations[:, 0]),
        observation_keypoint=observations[:, 1],
    )


def read_descriptors(
    database: str | Path, model_dir: str | Path, reconstruction: Any, model: ModelArrays
) -> list[NDArray[np.uint8]]:
    """Descriptors (K, 128) uint8 of the model's images, in the order of `model.image_ids`, joined by image name.

    Raises:
        MapError: the database is missing, unreadable, or not the one the model was built from.
    """
    import pycolmap

    path = Path(database)
    if not path.is_file():
        raise MapError(
            "there is no such database", path=path, fix="Give the database.db the model was built from, or none."
        )
    mismatch = f"Give the database that {model_dir} was built from, or none."
    descriptors = []
    try:
        with quiet_colmap(), pycolmap.Database.open(str(path)) as db:
            stored = {image.name: image.image_id for image in db.read_all_images()}
            for image_id, name in zip(model.image_ids, model.image_names, strict=True):
                if name not in stored:
                    raise MapError("the database lacks an image of the model", path=path, value=name, fix=mismatch)
                image = reconstruction.images[int(image_id)]
                keypoints = np.asarray(db.read_keypoints(stored[name]), dtype=np.float64)
                values = np.asarray(db.read_descriptors(stored[name]).data)
                if len(keypoints) != image.num_points2D() or len(values) != image.num_points2D():
                    problem = f"the database and the model disagree on the number of keypoints of {name}"
                    raise MapError(problem, path=path, value=(len(values), image.num_points2D()), fix=mismatch)
                if (
                    len(keypoints)
                    and np.abs(keypoints[[0, -1], :2] - [image.points2D[0].xy, image.points2D[-1].xy]).max() > 0.01
                ):
                    raise MapError(
                        "the database holds other keypoints than the model", path=path, value=name, fix=mismatch
                    )
                if values.ndim != 2 or values.shape[1] != 128 or values.dtype != np.uint8:
                    raise MapError("the descriptors are not SIFT", path=path, value=values.shape, fix=mismatch)
                descriptors.append(values)
    except (ValueError, IndexError, RuntimeError) as error:
        raise MapError(f"pycolmap cannot read the database: {error}", path=path, fix=mismatch) from error
    return descriptors


def _check_count(path: Path, least_bytes: int) -> None:
    if not path.is_file():
        return  # models from before COLMAP 3.12 have no rigs and frames
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(8)
    if len(head) < 8 or struct.unpack("<Q", head)[0] * least_bytes > size - 8:
        raise MapError("the file is truncated or corrupt", path=path, value=f"{size} bytes", fix=_REBUILD)


def _check_points(path: Path) -> None:
    data = path.read_bytes()
    _check_count(path, _POINT_BYTES)
    end = 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        if end + _POINT_BYTES > len(data):
            end = len(data) + 1
            break
        end += _POINT_BYTES + 8 * struct.unpack_from("<Q", data, end + _POINT_BYTES - 8)[0]
    _check_size(path, end)


def _check_size(path: Path, expected: int) -> None:
    if path.stat().st_size != expected:
        problem = "the file is truncated or corrupt"
        raise MapError(problem, path=path, value=f"{path.stat().st_size} bytes", fix=_REBUILD)
