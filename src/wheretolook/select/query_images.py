"""Images to localize in a map: read at the size of the map's images, with the camera that took them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import Camera, PinholeCamera, camera_of, cameras_by_id, describe_camera
from wheretolook.mapping.colmap_model import camera_of_model, registered_names
from wheretolook.mapping.photographs import read_photograph, reduce_photograph
from wheretolook.utils.colmap import quiet_colmap
from wheretolook.utils.errors import ConfigError, PoseError
from wheretolook.utils.files import path_ends

MAX_SIDE_PX = 1600  # larger images are reduced
MAX_SIDE_RATIO = 1.01  # of the proportions of an image and of its camera
MAX_FOCAL_RATIO = 1.05  # of focal lengths that count as equal; those in EXIF data are rounded


@dataclass(frozen=True, eq=False)
class QueryImage:
    """An image to localize, as its keypoints are extracted, and its camera."""

    name: str
    rgb: NDArray[np.uint8]  # (H, W, 3)
    camera: Camera  # of that size


class QueryImages:
    """Reads images for a `pycolmap.Reconstruction` in a folder.

    The camera of an image is the given one. Otherwise it is the model's: that of the mapping image of the same name, or
    of those of the same proportions if their focal lengths agree; unless the EXIF focal length contradicts it.
    Otherwise it is a pinhole of the EXIF focal length.
    """

    def __init__(self, model: Any, folder: Path) -> None:
        self.folder = folder
        self.model = model
        self.cameras = cameras_by_id(model.cameras, folder)
        names = registered_names(model)
        self.by_name = {name: self.cameras[model.images[number].camera_id] for number, name in names.items()}

    def known_camera(self, camera: Camera | int | None) -> Camera | None:
        """Return a camera, given as one or by its camera_id. Raises MapError if the model has no such camera."""
        if camera is not None and not isinstance(camera, (int, Camera)):
            raise ConfigError("this is no camera", value=camera, fix="Give a Camera, or a camera_id of the model.")
        return camera_of_model(self.model, self.folder, camera) if isinstance(camera, int) else camera

    def read(self, image: str | Path | NDArray[np.uint8], name: str, camera: Camera | None = None) -> QueryImage:
        """Read a file, or take an array (H, W, 3) uint8 RGB, of a given or known camera.

        Raises MapError if the file cannot be read, PoseError for an array that is no image, ConfigError if the camera
        is unknown or has other proportions.
        """
        if isinstance(image, np.ndarray):
            if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
                raise PoseError("an image is an array (H, W, 3) uint8", value=(image.shape, str(image.dtype)))
            return _fitted(name, image, self._camera(None, image, camera))
        path = Path(image)
        rgb = read_photograph(path)
        expected = camera or self._named(path)
        if expected is not None and not _has_proportions(expected, rgb):
            stored = read_photograph(path, turned=False)  # as some versions of COLMAP read photographs
            rgb = stored if _has_proportions(expected, stored) else rgb
        return _fitted(name, rgb, self._camera(path, rgb, camera))

    def _named(self, path: Path) -> Camera | None:
        """Return the camera of the mapping image of the same name: of the longest end of the path, at least the file name."""
        return next((self.by_name[end] for end in path_ends(path.absolute()) if end in self.by_name), None)

    def _camera(self, path: Path | None, rgb: NDArray[np.uint8], given: Camera | None) -> Camera:
        height, width = rgb.shape[:2]
        size = f"{width} x {height} px"
        if given is not None:
            if not _has_proportions(given, rgb):
                problem = f"the image of {size} has other proportions than the camera"
                raise ConfigError(problem, path=path, value=describe_camera(given), fix="Correct --camera.")
            return given
        named = None if path is None else self._named(path)
        alike = [camera for camera in self.cameras.values() if _has_proportions(camera, rgb)]
        if named is not None and named in alike:
            alike = [named]
        focal = np.array([camera.colmap.mean_focal_px / camera.width for camera in alike])
        in_exif = None if path is None else _exif_focal_px(path)
        if len(alike) and focal.max() <= MAX_FOCAL_RATIO * focal.min():
            camera = alike[int(np.argsort(focal)[len(focal) // 2])]
            ratio = 1.0 if in_exif is None else in_exif / width / focal.min()
            if 1 / MAX_FOCAL_RATIO**2 <= ratio <= MAX_FOCAL_RATIO**2:
                return camera
        if in_exif is not None:
            return PinholeCamera(width, height, in_exif)
        problem = f"the camera of this image of {size} is unknown: it has no EXIF focal length"
        problem += f", and the map has {len(alike)} cameras of its proportions that differ" if alike else ""
        raise ConfigError(problem, path=path, fix="Give --camera MODEL,width,height,parameters, in Python camera.")


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """Return the names of files, or where some are equal, the paths from the folder that has all."""
    names = [path.name for path in paths]
    if len({*names}) == len(names):
        return names
    folder = os.path.commonpath([path.absolute().parent for path in paths])
    return [os.path.relpath(path, folder) for path in paths]


def _has_proportions(camera: Camera, rgb: NDArray[np.uint8]) -> bool:
    height, width = rgb.shape[:2]
    ratio = width * camera.height / (height * camera.width)
    return 1 / MAX_SIDE_RATIO <= ratio <= MAX_SIDE_RATIO


def _fitted(name: str, rgb: NDArray[np.uint8], camera: Camera) -> QueryImage:
    """Reduce an image to the size of its camera and to `MAX_SIDE_PX`, and return it with the camera of that size."""
    import pycolmap

    reduced = reduce_photograph(rgb, min(MAX_SIDE_PX, max(camera.width, camera.height)))
    height, width = reduced.shape[:2]
    if (width, height) != (camera.width, camera.height):
        scaled = pycolmap.Camera(**camera.colmap.record())
        scaled.rescale(width, height)
        camera = camera_of(scaled.model_name, width, height, scaled.params)
    return QueryImage(name, reduced, camera)


def _exif_focal_px(path: Path) -> float | None:
    """Read the focal length of a photograph in pixels from its EXIF data; None without."""
    import pycolmap

    options = pycolmap.ImageReaderOptions(camera_model="SIMPLE_PINHOLE")
    try:
        with quiet_colmap():
            camera = pycolmap.infer_camera_from_image(path, options)
    except (ValueError, RuntimeError):  # a format that COLMAP does not read
        return None
    return float(camera.mean_focal_length()) if camera.has_prior_focal_length else None
