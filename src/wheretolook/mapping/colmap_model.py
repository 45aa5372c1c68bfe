"""Checks of COLMAP's model files around pycolmap's readers, and fast access to the points in them.

pycolmap trusts the counts in binary files and can loop for hours or run out of memory on a corrupt one, so these are
compared with the file's size before it reads, and values are checked afterwards. The formats are those of https://colmap.github.io/format.html."""

from __future__ import annotations

import itertools
import re
import warnings
from codecs import BOM_UTF8
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from mmap import ACCESS_READ, mmap
from pathlib import Path
from struct import Struct, error as StructError
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.geometry.camera import MAX_SIDE_PX, Camera, mean_focal_px, only_camera
from wheretolook.geometry.poses import Float, are_rotations, camera_centers
from wheretolook.geometry.similarity import local_origin
from wheretolook.utils.errors import MapError, MapWarning, StorageError
from wheretolook.utils.files import STORAGE_FIX, load_npz, save_npz, storage_errors, temporary_folder
from wheretolook.utils.texts import quiet_colmap

if TYPE_CHECKING:
    from scipy.sparse import csr_array


REBUILD = "Copy or build the model again."
# A point without its track. The track's elements follow: image id and index of the keypoint, uint32 each.
POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("n", "<u8")])
_UINT64 = Struct("<Q")
_MAX_COORDINATE = 1e12  # of a point or a camera; its square is still finite in single precision


def check_binary(folder: Path) -> None:
    """Raise MapError if counts in a folder's binary model do not match the files' sizes, or a point is not finite."""
    lengths = {"images": _image_length, "points3D": _point_length, "frames": _frame_length}
    for name, record_length in lengths.items():
        path = folder / f"{name}.bin"
        if path.is_file():  # models from before COLMAP 3.12 have no frames
            data = _mapped(path)
            starts = _record_starts(data, record_length, path)
            if name == "points3D":
                check_coordinates(_point_heads(data, starts), path)


def check_coordinates(points: NDArray[Any], path: Path) -> None:
    """Raise MapError if points (P,) of dtype `POINT` are not finite or farther away than any scene."""
    wrong = points[~(np.abs(points["xyz"]) <= _MAX_COORDINATE).all(axis=1)]
    if len(wrong):
        problem = f"point {wrong[0]['id']} is NaN, infinite or too far away"
        raise MapError(problem, path=path, value=wrong[0]["xyz"].tolist(), fix="Leave such points out of the model.")


def read_points(path: Path) -> tuple[NDArray[Any], NDArray[np.uint32]]:
    """Read a points3D.bin: points (P,) of dtype `POINT`, sorted by id, and their tracks, (O, 2) image id and keypoint.

    Reading 500,000 points one by one with pycolmap takes 15 seconds.
    """
    data = _mapped(path)
    starts = _record_starts(data, _point_length, path)
    points = _point_heads(data, starts)
    order = np.argsort(points["id"])
    points = points[order]
    n = points["n"].astype(np.int64)
    track_start = starts[:-1][order] + POINT.itemsize
    at = np.repeat(track_start - 8 * (np.cumsum(n) - n), n) + 8 * np.arange(n.sum())
    return points, _records(data, at, np.dtype(("<u4", 2)))


def _mapped(path: Path) -> NDArray[np.uint8]:
    """Bytes of a file, which are read where they are used: counts are checked before a sparse file of terabytes is read."""
    if path.stat().st_size < _UINT64.size:
        raise MapError("the file is truncated or corrupt", path=path, value=f"{path.stat().st_size} bytes", fix=REBUILD)
    return np.memmap(path, dtype=np.uint8, mode="r")


@contextmanager
def without_marks(folder: Path, suffix: str) -> Iterator[Path]:
    """Yield a model's folder, or a copy of its texts without the byte-order marks that pycolmap cannot read."""
    names = ("cameras", "images", "points3D", "rigs", "frames") if suffix == ".txt" else ()
    texts = [path for name in names if (path := folder / (name + suffix)).is_file()]
    has_mark = False
    for path in texts:
        with path.open("rb") as file:
            has_mark |= file.read(len(BOM_UTF8)) == BOM_UTF8
            if path.stat().st_size and mmap(file.fileno(), 0, access=ACCESS_READ).find(b"\0") >= 0:
                # the hole of a sparse file is one line of any length
                raise MapError("the file is no text: it has a byte 0", path=path, fix=REBUILD)
    if not has_mark:
        yield folder
        return
    with temporary_folder() as copy:
        for path in texts:
            (copy / path.name).write_bytes(path.read_bytes().removeprefix(BOM_UTF8))
        yield copy


def _announced(path: Path) -> int:
    """Number of entries that COLMAP writes at the top of a text file; 0 if there is none."""
    with path.open(errors="replace") as file:
        head = "".join(line for line in itertools.islice(file, 6) if line.startswith("#"))
    announced = re.search(r"# Number of \w+: (\d+)", head)
    return int(announced[1]) if announced else 0


def check_cameras_and_images(model: Any, folder: Path, suffix: str) -> None:
    """Raise MapError, which names the file, if a `pycolmap.Reconstruction` has an impossible camera or pose."""
    path = folder / f"cameras{suffix}"
    n_bytes = 8 + sum(24 + 8 * len(camera.params) for camera in model.cameras.values())
    if suffix == ".bin" and n_bytes != path.stat().st_size:
        raise MapError("the file is truncated or corrupt", path=path, value=f"not {n_bytes} bytes", fix=REBUILD)
    for number, camera in model.cameras.items():
        sides = (camera.width, camera.height)
        focal = camera.params[camera.focal_length_idxs()]
        if not (0 < min(sides) <= max(sides) <= MAX_SIDE_PX and np.isfinite(camera.params).all() and (focal > 0).all()):
            problem = f"camera {number} needs an image size, finite parameters and a positive focal length"
            raise MapError(problem, path=path, value=(*sides, *camera.params), fix="Correct the camera.")
    for number, image in model.images.items():
        _ = image.name  # raises UnicodeDecodeError if it is not in UTF-8
        if image.has_pose and not _is_pose(image.cam_from_world()):
            path = folder / f"frames{suffix}"
            path = path if path.is_file() else folder / f"images{suffix}"
            raise MapError(f"the pose of image {number} is not a rotation and translation", path=path, fix=REBUILD)


def _point_heads(data: NDArray[np.uint8], starts: NDArray[np.int64]) -> NDArray[Any]:
    """Points (P,) of dtype `POINT` in the bytes of a points3D.bin, without their tracks."""
    return _records(data, starts[:-1], POINT)


def _records(data: NDArray[np.uint8], starts: NDArray[np.int64], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Records of one type at offsets of bytes that need not be aligned."""
    if len(starts) == 0:
        return np.zeros(0, dtype=dtype)
    return sliding_window_view(data, dtype.itemsize)[starts].view(dtype.base).reshape(-1, *dtype.shape)


def _is_pose(rigid: Any) -> bool:
    """Whether a `pycolmap.Rigid3d` is a rotation and a translation of usual size."""
    matrix = rigid.matrix()
    known = np.linalg.norm(rigid.rotation.quat) > 0.5  # of a quaternion of length 0 the matrix is the identity
    near = np.abs(matrix[:, 3]).max() <= _MAX_COORDINATE
    return bool(known and near and are_rotations(matrix[:, :3], 0.01))  # some tools write few decimals


def _record_starts(
    data: NDArray[np.uint8], record_length: Callable[[memoryview, int], int], path: Path
) -> NDArray[np.int64]:
    """Offsets of the records after a file's count, and of its end.

    Raises MapError if they do not fill the file, or one begins as the one before it, as in a file of zeros.
    """
    buffer = data.data
    starts = [_UINT64.size]
    head = b""
    try:
        for _ in range(_UINT64.unpack_from(buffer)[0]):
            before, head = head, bytes(buffer[starts[-1] : starts[-1] + 8])  # ids differ
            if head == before:
                raise ValueError("two records of one id")
            starts.append(starts[-1] + record_length(buffer, starts[-1]))
    except (StructError, IndexError, ValueError, OverflowError):
        starts.append(-1)
    if starts[-1] != len(data):
        raise MapError("the file is truncated or corrupt", path=path, value=f"{len(data)} bytes", fix=REBUILD)
    return np.array(starts, dtype=np.int64)


def model_error(error: Exception, folder: Path, suffix: str) -> MapError:
    """Convert an error of pycolmap about a model's files to a MapError that names the file, where the error does."""
    files_by_error = (  # patterns in pycolmap's errors, and the file that they are about
        (r"Camera model|VerifyParams|cameras_|camera\.camera_id", "cameras"),
        ("point2D.point3D_id|line_stream[12]|utf-8", "images"),
        ("Image with ID|vector::|point3D.xyz", "points3D"),
        ("rig_from_world|data_id|unordered_map", "frames"),
        ("[Rr]ig|[Cc]amera|[Ss]ensor", "rigs"),
        ("[Ff]rame", "frames"),
    )
    name = next((name for pattern, name in files_by_error if re.search(pattern, str(error))), None)
    path = folder / f"{name}{suffix}" if name else folder
    return MapError(f"pycolmap cannot read the model: {error}", path=path, fix=REBUILD)


def _image_length(data: memoryview, start: int) -> int:
    name_end = start + 64 + bytes(data[start + 64 : start + 64 + 4097]).index(b"\0") + 1  # longer than any path
    return name_end + 8 + 24 * int(_UINT64.unpack_from(data, name_end)[0]) - start


def _point_length(data: memoryview, start: int) -> int:
    return POINT.itemsize + 8 * int(_UINT64.unpack_from(data, start + POINT.itemsize - 8)[0])


def _frame_length(data: memoryview, start: int) -> int:
    return 68 + 16 * int(Struct("<I").unpack_from(data, start + 64)[0])


LANDMARKS_FILE = "landmarks.npz"  # in the folder of a map of this project
CAMERAS_FILE = "cameras.npz"  # next to the landmarks; small enough to be shipped without the COLMAP model
MODEL_FILES = ("cameras", "images", "points3D")


@dataclass(frozen=True, eq=False)
class ModelArrays:
    """A reconstruction as arrays. Points are sorted by id, observations by point and then as in the point's track."""

    point_ids: NDArray[np.int64]  # (P,)
    points: NDArray[np.float64]  # (P, 3) world
    errors_px: NDArray[np.float64]  # (P,) mean reprojection error
    image_ids: NDArray[np.int64]  # (I,) ascending
    image_names: list[str]  # I names
    image_poses: NDArray[np.float64]  # (I, 3, 4) cam_from_world
    image_centers: NDArray[np.float64]  # (I, 3) camera centres in the world
    image_cameras: NDArray[np.int64]  # (I,) camera_id of the image's camera
    image_focal_px: NDArray[np.float64]  # (I,) its mean focal length
    observation_start: NDArray[np.int64]  # (P + 1,); observations start[i] to start[i + 1] belong to point i
    observation_image: NDArray[np.int64]  # (O,) row in `image_ids`
    observation_keypoint: NDArray[np.int64]  # (O,) index of the keypoint in its image
    observation_pixels: NDArray[np.float32] | None = None  # (O, 2) its position

    @property
    def track_lengths(self) -> NDArray[np.int64]:
        """Number of observations of each point, (P,)."""
        return np.diff(self.observation_start)

    @property
    def observation_point(self) -> NDArray[np.int64]:
        """Row of the point of each observation, (O,)."""
        return np.repeat(np.arange(len(self.points)), self.track_lengths)

    def of_points(self, ids: NDArray[np.int64]) -> ModelArrays:
        """Return the points of some ids, with their observations."""
        return select_points(self, np.isin(self.point_ids, ids))


def model_suffix(model_dir: str | Path) -> str:
    """Suffix of the model's files in a folder: ".bin" or ".txt". Raises MapError if the model is missing or incomplete."""
    folder = Path(model_dir)
    suffix = next((s for s in (".bin", ".txt") if any((folder / (n + s)).is_file() for n in MODEL_FILES)), None)
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
    n_bytes = sum((folder / (name + suffix)).stat().st_size for name in MODEL_FILES)
    bar = tqdm(total=2, desc=f"model of {n_bytes / 1e9:.1f} GB: read", unit="step", disable=n_bytes < 500e6)
    with bar, quiet_colmap():
        if suffix == ".bin":
            check_binary(folder)
        bar.update()
        model = _consistent(_read_files(folder, suffix), folder, suffix)
        bar.update()
    _warn_of_larger(folder, model.num_images())
    return model


def _read_files(folder: Path, suffix: str) -> Any:
    """Read a model with pycolmap. Raises MapError, which names the file, if that fails or a camera or pose is impossible."""
    import pycolmap

    model = pycolmap.Reconstruction()
    try:
        with without_marks(folder, suffix) as readable:
            (model.read_binary if suffix == ".bin" else model.read_text)(str(readable))
        check_cameras_and_images(model, folder, suffix)
    except (ValueError, LookupError, RuntimeError, MemoryError) as error:
        raise model_error(error, folder, suffix) from error
    if suffix == ".txt":
        numbers = (model.num_cameras(), model.num_images(), model.num_points3D())
        for name, number in zip(MODEL_FILES, numbers, strict=True):
            path = folder / f"{name}.txt"
            if number < (announced := _announced(path)):
                raise MapError(f"the file is truncated: it announces {announced}", path=path, value=number, fix=REBUILD)
        heads = [(number, point.xyz) for number, point in model.points3D.items()]
        check_coordinates(np.array(heads, dtype=[("id", "u8"), ("xyz", "f8", 3)]), folder / "points3D.txt")
    return model


def _consistent(model: Any, folder: Path, suffix: str) -> Any:
    """Return the model in a folder if its points reproject to their observations, or the one without rigs and frames.

    Rigs and frames are older than the other files if a program wrote only these, as before COLMAP 3.12. A `MapWarning`
    reports that, and observations in pixels of images of another size than the cameras'. Raises MapError for points,
    poses and cameras that contradict one another.
    """
    error = _contradiction(model)
    if not error:
        return model
    with temporary_folder() as copy, suppress(MapError):
        if (folder / f"frames{suffix}").is_file():
            for name in MODEL_FILES:
                (copy / (name + suffix)).symlink_to((folder / (name + suffix)).resolve())
            without_frames = _read_files(copy, suffix)
            if not _contradiction(without_frames):
                text = (
                    f"{folder}: rigs and frames contradict the points ({error}); the poses in images{suffix} are used"
                )
                warnings.warn(text, MapWarning, stacklevel=4)
                return without_frames
    pixels = np.concatenate(_reprojections(model))
    size = float(np.nanmedian(pixels[:, 1] / np.where(pixels[:, 0] > 1, pixels[:, 0], np.nan)))
    if size > 0 and not _contradiction(model, size):
        text = f"{folder}: observations are in images {size:.3g} times as large as those of the cameras, which are used"
        warnings.warn(text, MapWarning, stacklevel=4)
        return model
    problem = f"cameras, poses and points contradict one another: {error}"
    fix = "Copy all files of one reconstruction; a transformation applies to points, images and frames."
    raise MapError(problem, path=folder, fix=fix)


def _contradiction(model: Any, size: float = 1.0) -> str:
    """Describe how many images of a model see points off their observations, in pixels of images `size` times as large.

    Returns "" if that is at most a tenth of them, given the stated errors of the points, and frames have known images.
    """
    if missing := {data.id for frame in model.frames.values() for data in frame.image_ids} - {*model.images}:
        return f"{len(missing)} images of the frames are missing"
    side_px = max((max(camera.width, camera.height) for camera in model.cameras.values()), default=1) * size
    # COLMAP drops observations with larger errors than 4 px; programs that state no errors may keep them
    stated_px = model.compute_mean_reprojection_error() or side_px / 400
    limit_px = min(max(4.0, 4 * stated_px), side_px / 20)
    near = [np.linalg.norm(size * pixels[:, 0] - pixels[:, 1], axis=1) <= limit_px for pixels in _reprojections(model)]
    wrong = sum(of_image.mean() < 0.5 for of_image in near)
    return f"{wrong} of {len(near)} images see most points over {limit_px:.0f} px off" if 10 * wrong > len(near) else ""


def _reprojections(model: Any) -> list[Float]:
    """Pixels (K, 2, 2), projected and observed, of about 20 observations in each of about 50 images; NaN behind the camera.

    Images with all observations at one pixel are left out: some converters do not know them.
    """
    images = [image for image in model.images.values() if image.has_pose and image.num_points3D]
    sample = []
    for image in images[:: 1 + len(images) // 50]:
        rows = image.get_observation_point2D_idxs()
        observed = [image.points2D[row] for row in rows[:: 1 + len(rows) // 20]]
        observed = [point for point in observed if point.point3D_id in model.points3D]
        projected = [image.project_point(model.points3D[point.point3D_id].xyz) for point in observed]
        behind = (np.nan, np.nan)
        pairs = [(behind if at is None else at, point.xy) for at, point in zip(projected, observed, strict=True)]
        sample.append(np.array(pairs, dtype=np.float64))
    return [pixels for pixels in sample if len(pixels) and np.ptp(pixels[:, 1], axis=0).any()]


def _warn_of_larger(folder: Path, n_images: int) -> None:
    """Warn of a model of more images among those of one reconstruction: sparse/N of COLMAP, models/N of hloc."""
    others = [*folder.glob("models/*/images.*")]
    if folder.name.isdigit():
        others += folder.parent.glob("[0-9]*/images.*")
    for path in others:
        with suppress(OSError):
            n_others = _count_images(path)
            if n_others > n_images:
                text = f"{folder} has {n_images} images, the model in {path.parent} has {n_others:,}: is that the map?"
                warnings.warn(text, MapWarning, stacklevel=3)


def _count_images(path: Path) -> int:
    """Number of images in an images.bin or images.txt; 0 for another file."""
    if path.suffix == ".bin":
        with path.open("rb") as file:
            return int.from_bytes(file.read(8), "little")
    if path.suffix != ".txt":
        return 0
    with path.open(errors="replace") as file:  # an image's line ends in its name, one of keypoints in a number
        return _announced(path) or sum(bool(re.match(r"[^#\s].*[^\d\s]\s*$", line)) for line in file)


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
    points, elements, pixels = _points_and_tracks(reconstruction)
    if not (points["error"][points["n"] > 0] >= 0).all():  # COLMAP writes -1 for an unknown error
        reconstruction.update_point_3d_errors()
        points, elements, pixels = _points_and_tracks(reconstruction)
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
        image_poses=np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4),
        image_centers=np.array([image.projection_center() for image in images], dtype=np.float64).reshape(-1, 3),
        image_cameras=np.array([image.camera_id for image in images], dtype=np.int64),
        image_focal_px=np.array([mean_focal_px(reconstruction.cameras[image.camera_id]) for image in images]),
        observation_start=np.concatenate([[0], np.cumsum(points["n"])]).astype(np.int64),
        observation_image=np.searchsorted(image_ids, elements[:, 0]),
        observation_keypoint=elements[:, 1].astype(np.int64),
        observation_pixels=pixels,
    )


def select_points(model: ModelArrays, keep: NDArray[np.bool_]) -> ModelArrays:
    """Select the points (P,) of a model for which `keep` is true, with their observations."""
    lengths = model.track_lengths
    rows = np.repeat(keep, lengths)
    return replace(
        model,
        point_ids=model.point_ids[keep],
        points=model.points[keep],
        errors_px=model.errors_px[keep],
        observation_start=np.concatenate([[0], np.cumsum(lengths[keep])]),
        observation_image=model.observation_image[rows],
        observation_keypoint=model.observation_keypoint[rows],
        observation_pixels=None if model.observation_pixels is None else model.observation_pixels[rows],
    )


def observation_matrix(model: ModelArrays, group: NDArray[np.integer[Any]] | None = None) -> csr_array:
    """Which images, or groups (I,) of images, observe which points: a sparse matrix (I or number of groups, P) of ones.

    Its product with its own transpose counts the points that two images share.
    """
    point = model.observation_point
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


def find_camera(cameras: Mapping[int, Camera], path: Path, camera: Camera | int | None = None) -> Camera:
    """Return a camera, given as one or by its id among those of a model; None for the only one.

    Raises MapError, naming the model's folder, if there is no such camera, or there are several.
    """
    if camera is None:
        return only_camera(cameras, path)
    if not isinstance(camera, int):
        return camera
    if camera not in cameras:
        fix = f"It has {', '.join(map(str, cameras))}."
        raise MapError("the model has no such camera", path=path, value=camera, fix=fix)
    return cameras[camera]


def registered_names(reconstruction: Any) -> dict[int, str]:
    """Names of the images with a pose, by id, in the order of ids."""
    return {number: image.name for number, image in sorted(reconstruction.images.items()) if image.has_pose}


def describe_cameras(reconstruction: Any) -> list[dict[str, Any]]:
    """Model, size and parameters of each camera of a `pycolmap.Reconstruction`, as values of JSON."""
    cameras = [camera for _, camera in sorted(reconstruction.cameras.items())]
    return [{"model": c.model_name, "width": c.width, "height": c.height, "params": c.params.tolist()} for c in cameras]


def holds_model(folder: Path) -> bool:
    """Whether a folder holds a COLMAP model, binary or text."""
    return any(all((folder / (name + suffix)).is_file() for name in MODEL_FILES) for suffix in (".bin", ".txt"))


def save_mapping_poses(cam_from_world: Float, path: str | Path) -> None:
    """Write poses (M, 3, 4) as an NPZ file, see `compact_poses`, atomically. The same poses give the same bytes."""
    save_npz(Path(path), {"cam_from_world": compact_poses(cam_from_world)})


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


def _points_and_tracks(reconstruction: Any) -> tuple[NDArray[Any], NDArray[np.uint32], NDArray[np.float32]]:
    """Points and tracks of a reconstruction as `read_points` gives them, and the pixels (O, 2) of the tracks."""
    with temporary_folder() as folder:
        reconstruction.write_binary(folder)
        points, elements = read_points(folder / "points3D.bin")
        return points, elements, _read_pixels(folder / "images.bin", elements)


def _read_pixels(path: Path, elements: NDArray[np.uint32]) -> NDArray[np.float32]:
    """Read where keypoints are, (O, 2), from an images.bin; elements (O, 2) are their image ids and indices."""
    data = _mapped(path)
    starts = _record_starts(data, _image_length, path)
    order = np.argsort(elements[:, 0], kind="stable")
    ids = _records(data, starts[:-1], np.dtype("<u4")).reshape(-1)
    first, last = (np.searchsorted(elements[order, 0], ids, side) for side in ("left", "right"))
    keypoint = np.dtype([("xy", "<f8", 2), ("point", "<u8")])
    pixels = np.empty((len(elements), 2), dtype=np.float32)
    for start, end, begin, stop in zip(starts[:-1], starts[1:], first, last, strict=True):
        name_end = start + 64 + bytes(data[start + 64 : end]).index(b"\0") + 1
        rows = order[begin:stop]
        pixels[rows] = data[name_end + 8 : end].view(keypoint)["xy"][elements[rows, 1]]
    return pixels
