"""Reads images to localize: their pixels as the map reads its own, and their cameras, known or assumed."""

from __future__ import annotations

import filecmp
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from wheretolook.geometry.camera import (
    EQUIRECTANGULAR,
    Camera,
    ColmapCamera,
    PinholeCamera,
    camera_of,
    describe_camera,
    read_named_cameras,
    turn_camera,
)
from wheretolook.geometry.camera_files import read_camera
from wheretolook.geometry.poses import CUBE_FACES, Float
from wheretolook.localization.rig import FocalPrior
from wheretolook.mapping.colmap_model import find_camera
from wheretolook.mapping.map import Map, find_photographs, has_image, reads_upright
from wheretolook.mapping.photographs import exif_focal_px, quarters_upright, read_photograph, reduce_photograph
from wheretolook.utils.errors import ConfigError, PoseError
from wheretolook.utils.files import path_ends, read_text

KnownCamera = Camera | Mapping[str, Camera]  # of all images, or by their names


@dataclass(frozen=True, eq=False)
class QueryImage:
    """An image to localize, as its keypoints are extracted, and its camera.

    Attributes:
        name: of the image.
        rgb: (H, W, 3) uint8, with the axes of the pose.
        camera: of that size.
        camera_from: what the camera is: "given", "listed", "mapping image NAME"; or "assumed: ..." with the camera of the
            map or the EXIF focal length.
        focal: what is assumed of its focal length; None if the camera is known.
        quarters: quarter turns to the left that make the image upright by its EXIF data.
        is_turned: whether keypoints are extracted from the image turned so.
        others: further readings of the image, if it is uncertain how its camera was held.
    """

    name: str
    rgb: NDArray[np.uint8]
    camera: Camera
    camera_from: str = "given"
    focal: FocalPrior | None = None
    quarters: int = 0
    is_turned: bool = False
    others: tuple[QueryImage, ...] = ()


class QueryImages:
    """Reads images to localize in a map, opened from a COLMAP model.

    Pixels are those as stored, as COLMAP and hloc read them, or upright by EXIF if the map's are; if only the other
    reading has the proportions of the camera, it is taken.

    The camera of an image is the given or listed one, or that of the mapping image of the same name, if it is that image.
    Otherwise it is assumed to be one of the map of the same proportions, also if it was turned by a quarter, or without any a pinhole of
    the EXIF focal length.
    """

    def __init__(self, opened: Map) -> None:
        assert opened.path is not None and opened.images is not None
        self.folder = opened.path
        self.mapping = opened.images
        self.cameras = opened.cameras
        ids = opened.images.image_cameras.tolist()
        self.by_name = {name: self.cameras[i] for name, i in zip(opened.images.image_names, ids, strict=True)}
        self.upright = reads_upright(opened.path)

    def known_camera(self, camera: Camera | int | str | Path | None) -> KnownCamera | None:
        """Return a camera, given as one, by its camera_id, as a text, or as a file: of one, or a list of those of images.

        "panorama" is an equirectangular camera with as many pixels per degree as the centres of the map's images.
        Raises MapError if the model has no such camera, ConfigError or TableError if the text or the file has none.
        """
        if camera == "panorama":
            half = round(np.pi * np.median([one.colmap.mean_focal_px for one in self.cameras.values()]))
            return ColmapCamera(EQUIRECTANGULAR, 2 * half, half, (2 * half, half))
        if isinstance(camera, (str, Path)):
            lists = None
            with suppress(OSError, ValueError):
                lists = re.search(r"(?m)^[ \t]*[^#\s].*?\s\w+\s+\d+\s+\d+\s", read_text(Path(camera), 2**28))
            return read_named_cameras(Path(camera)) if lists else read_camera(str(camera))
        if camera is not None and not isinstance(camera, (int, Camera)):
            fix = "Give a Camera, a camera_id of the model, or a file of cameras."
            raise ConfigError("this is no camera", value=camera, fix=fix)
        return None if camera is None else find_camera(self.cameras, self.folder, camera)

    def read(self, image: str | Path | NDArray[np.uint8], name: str, camera: KnownCamera | None = None) -> QueryImage:
        """Read a file, or take an array (H, W, 3) uint8 RGB, of a given or known camera.

        Raises MapError if the file cannot be read, PoseError for an array that is no image, ConfigError if the camera
        is unknown or has other proportions.
        """
        path = None if isinstance(image, np.ndarray) else Path(image)
        if isinstance(image, np.ndarray):
            if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
                raise PoseError("an image is an array (H, W, 3) uint8", value=(image.shape, str(image.dtype)))
            readings = [image]
        else:
            readings = [read_photograph(Path(image), self.upright)]
            if quarters_upright(Path(image)):
                readings.append(read_photograph(Path(image), not self.upright))
        known, known_from = self._known(path, name, camera, readings)
        candidates = [*self.cameras.values()] if known is None else [known]
        fitting = [rgb for rgb in readings if any(_has_proportions(one, rgb) for one in candidates)]
        rgb = (fitting or readings)[0]
        quarters = 0 if path is None or self.upright is (rgb is readings[0]) else quarters_upright(path) % 4
        if known is None:
            return replace(self._assumed(path, name, rgb), quarters=quarters)
        if not fitting:
            problem = f"the image of {_size(rgb)} has other proportions than the camera"
            fix = "Correct --camera."
            if is_panorama(known):
                problem = f"the image of {_size(rgb)} is no equirectangular panorama"
                fix = "Give an image of 360 x 180 degrees, twice as wide as high, or localize it without --panorama."
            raise ConfigError(problem, path=path, value=describe_camera(known), fix=fix)
        return replace(_fitted(name, rgb, known, known_from), quarters=quarters)

    def photograph(self, name: str) -> Path | None:
        """Return the file of a mapping image; None if it is not found."""
        folder = self._photographs
        return folder / name if folder is not None and has_image(folder, name) else None

    @cached_property
    def _photographs(self) -> Path | None:
        return find_photographs(self.folder)

    def _is_mapping_image(self, path: Path, readings: Sequence[NDArray[np.uint8]], name: str) -> bool:
        """Test whether a file is the mapping image of this name, not another zoom, size or place.

        It is the same file. Where the photographs are not found, it must have the proportions and at least the size of the
        camera, and no EXIF focal length that contradicts it.
        """
        original = self.photograph(name)
        if original is not None:
            return filecmp.cmp(path, original, shallow=False)
        in_exif = exif_focal_px(path)
        camera = self.by_name[name]
        ratio = max(readings[0].shape) / max(camera.width, camera.height)
        if ratio < 1 or not any(_has_proportions(camera, rgb) for rgb in readings):
            return False
        expected = camera.colmap.mean_focal_px * ratio
        return in_exif is None or 0.95 < in_exif / expected < 1.05  # as in `_assumed`

    def _known(
        self, path: Path | None, name: str, given: KnownCamera | None, readings: Sequence[NDArray[np.uint8]]
    ) -> tuple[Camera | None, str]:
        """Return the camera that was given or listed, or that of the mapping image of the same name.

        Names are the longest ends of the path that are known, at least the file name.
        """
        ends = path_ends(Path(name) if path is None else path.absolute())
        if isinstance(given, Mapping):
            listed = next((given[end] for end in ends if end in given), None)
            if listed is None:
                raise ConfigError("the list of cameras does not name this image", path=path, value=name)
            return listed, "listed"
        if given is not None or path is None:
            return given, "given"
        found = next((end for end in ends if end in self.by_name), None)
        if found is None or not self._is_mapping_image(path, readings, found):
            return None, ""
        return self.by_name[found], f"mapping image {found}"

    def _assumed(self, path: Path | None, name: str, rgb: NDArray[np.uint8]) -> QueryImage:
        """Assume the camera of an image: one of the map, whatever the EXIF data say, or a pinhole by these."""
        height, width = rgb.shape[:2]
        in_exif = None if path is None else exif_focal_px(path)
        fits = any(_has_proportions(one, rgb) for one in self.cameras.values())
        turns, shown = ([0], rgb) if fits else ([1, 3], np.swapaxes(rgb, 0, 1))
        cameras = {number: one for number, one in self.cameras.items() if _has_proportions(one, shown)}
        if not cameras and in_exif is not None:
            focal = FocalPrior((in_exif,), (0.03,))  # whole millimetres; crops and resized photographs
            return _fitted(name, rgb, PinholeCamera(width, height, in_exif), "assumed: EXIF focal length", focal)
        if not cameras:
            problem = f"the camera of this image of {_size(rgb)} is unknown: it has no EXIF focal length,"
            problem += " and the map has no camera of its proportions"
            fix = "Give --camera MODEL,width,height,parameters, in Python camera."
            raise ConfigError(problem, path=path, fix=fix)
        longer = max(width, height)
        focal_px = {n: one.colmap.mean_focal_px * longer / max(one.width, one.height) for n, one in cameras.items()}
        expected = float(np.median([*focal_px.values()])) if in_exif is None else in_exif
        number = min(focal_px, key=lambda n: abs(np.log(focal_px[n] / expected)))
        values = [focal_px[number]]
        for value in (min(focal_px.values()), max(focal_px.values())):
            if all(abs(np.log(value / other)) > 0.01 for other in values):
                values.append(value)
        deviations = [0.0] * len(values)
        if in_exif is not None and abs(np.log(in_exif / values[0])) > 0.05:
            values.append(in_exif)
            deviations.append(0.03)
        focal = FocalPrior(tuple(values), tuple(deviations))
        source = f"assumed: camera {number} of the map"
        source += ", turned by 90 degrees" if turns[0] else ""
        readings = {turn_camera(cameras[number], turn): None for turn in turns}
        first, *others = (_fitted(name, rgb, camera, source, focal) for camera in readings)
        return replace(first, others=tuple(others))


def is_panorama(camera: Camera) -> bool:
    """Return whether the images of a camera are equirectangular."""
    return camera.colmap.model == EQUIRECTANGULAR


def cut_panorama(panorama: QueryImage) -> tuple[list[QueryImage], Float]:
    """Cut an equirectangular image into the faces of a cube; return them with their cam_from_rig (6, 3, 4).

    The rig has the axes of the panorama: x right, y down, z forward to the centre of its image, as the first face.
    Faces are pinholes of 90 degrees, with the pixels per degree of the panorama at their centres.
    """
    import cv2

    height, width = panorama.rgb.shape[:2]
    side = 2 * max(1, round(width / (2 * np.pi)))
    camera = PinholeCamera(side, side, side / 2)
    rays = camera.unproject(np.stack(np.meshgrid(*2 * [np.arange(side) + 0.5]), axis=-1))
    images = []
    for number, cam_from_rig in enumerate(CUBE_FACES):
        x, y, z = np.moveaxis(rays @ cam_from_rig, -1, 0)
        columns = ((np.arctan2(x, z) / (2 * np.pi) + 0.5) * width - 0.5).astype(np.float32)
        rows = ((np.arcsin(y) / np.pi + 0.5) * height - 0.5).astype(np.float32)
        rgb = cv2.remap(panorama.rgb, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        images.append(QueryImage(f"{panorama.name} {number}", np.asarray(rgb, np.uint8), camera))
    return images, np.pad(CUBE_FACES, ((0, 0), (0, 0), (0, 1)))


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """Return the names of files, or where some are equal, the paths from the folder that has all."""
    names = [path.name for path in paths]
    if len({*names}) == len(names):
        return names
    folder = os.path.commonpath([path.absolute().parent for path in paths])
    return [os.path.relpath(path, folder) for path in paths]


def _size(rgb: NDArray[np.uint8]) -> str:
    return f"{rgb.shape[1]} x {rgb.shape[0]} px"


def _has_proportions(camera: Camera, rgb: NDArray[np.uint8]) -> bool:
    """Return whether an image has the proportions of a camera, within 1 %."""
    height, width = rgb.shape[:2]
    return 0.99 <= width * camera.height / (height * camera.width) <= 1.01


def _fitted(
    name: str, rgb: NDArray[np.uint8], camera: Camera, camera_from: str, focal: FocalPrior | None = None
) -> QueryImage:
    """Reduce an image to the size of its camera, at most 1,600 px; return it with the camera and prior of that size."""
    largest = 1600 * np.pi if is_panorama(camera) else 1600  # so that a face of 90 degrees has 1,600 px
    reduced = reduce_photograph(rgb, min(round(largest), max(camera.width, camera.height)))
    height, width = reduced.shape[:2]
    if focal is not None:
        ratio = max(width, height) / max(rgb.shape[:2])
        focal = replace(focal, focal_px=tuple(value * ratio for value in focal.focal_px))
    if (width, height) != (camera.width, camera.height):
        scaled = pycolmap.Camera(**camera.colmap.record())
        scaled.rescale(width, height)
        camera = camera_of(scaled.model_name, width, height, scaled.params)
    return QueryImage(name, reduced, camera, camera_from, focal)
