"""Read photographs, upright and reduced, and the intrinsics of their cameras."""

from __future__ import annotations

import os
import struct
from collections import Counter
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from wheretolook.geometry.camera import ColmapCamera
from wheretolook.mapping.config import PhotographsConfig
from wheretolook.utils.errors import ConfigError, MapError
from wheretolook.utils.files import read_image
from wheretolook.utils.texts import LOG, quiet_colmap

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")


def list_photographs(folder: Path, at_least: int = 2) -> list[str]:
    """List photographs in a folder and its subfolders by relative name, as `find_photograph_files` does.

    Raises MapError if there are fewer than `at_least`, or a name is not in UTF-8, which COLMAP needs.
    """
    if not folder.is_dir():
        raise MapError("there is no such folder", path=folder, fix="Give the folder of the photographs.")
    names = [path.relative_to(folder).as_posix() for path in find_photograph_files(folder)]
    for name in names:
        if name != name.encode(errors="replace").decode():
            raise MapError("the name of a photograph is not in UTF-8", path=folder, value=name, fix="Rename it.")
    if len(names) < at_least:
        fix = f"Give at least {at_least}; files that end in {', '.join(SUFFIXES)} count."
        raise MapError("there are too few photographs in the folder", path=folder, value=len(names), fix=fix)
    return names


def find_photograph_files(folder: Path) -> list[Path]:
    """List the files of photographs in a folder and its subfolders, also those behind links, sorted by name.

    Logs what is left out: depth images, and numbers of files in other formats.
    """
    files: list[Path] = []
    visited = set[str]()
    for parent, folders, names in os.walk(folder, followlinks=True):
        folders.sort()
        real = os.path.realpath(parent)
        if real in visited:  # by another link, which may be a cycle
            folders.clear()
            continue
        visited.add(real)
        files += [path for name in names if (path := Path(parent, name)).is_file()]
    photographs = [path for path in files if path.suffix.lower() in SUFFIXES]
    others = Counter(path.suffix.lower() for path in files if path.suffix.lower() not in ("", *SUFFIXES))
    if others:
        listed = ", ".join(f"{number} {suffix}" for suffix, number in sorted(others.items()))
        _warn_once("%s: files in other formats are left out: %s", folder, listed)
    depth = _depth_images(photographs)
    if depth:
        text = "%s: %d depth images (16-bit grey, named depth or numbered as a photograph) are left out"
        _warn_once(text, folder, len(depth))
    return sorted(set(photographs) - depth, key=lambda path: path.relative_to(folder).as_posix())


_warn_once = cache(LOG.warning)  # a folder is listed several times


def _depth_images(photographs: list[Path]) -> set[Path]:
    """Return the PNGs of 16-bit grey that are named depth, or have the number of another photograph."""
    grey = {path for path in photographs if _is_16_bit_grey(path)}
    numbers = {_number(path) for path in photographs if path not in grey}
    return {path for path in grey if "depth" in f"{path.parent.name}/{path.name}".lower() or _number(path) in numbers}


def _number(path: Path) -> str:
    """Return the digits in a file's name, or without any its first part."""
    return "".join(filter(str.isdecimal, path.stem)) or path.name.partition(".")[0]


def _is_16_bit_grey(path: Path) -> bool:
    """Return whether a file is a PNG of one channel with 16 bits, by its header."""
    if path.suffix.lower() != ".png" or not os.access(path, os.R_OK):
        return False
    with path.open("rb") as file:
        return file.read(26)[24:] == b"\x10\x00"


def read_photograph(path: Path, turned: bool = True) -> NDArray[np.uint8]:
    """Read a photograph (H, W, 3) uint8 RGB, turned upright by its EXIF orientation, or as stored.

    Of 16-bit pixels, the highest 8 bits in use are read: of 10, 12, 14 or 16, the fewest that hold the brightest pixel.
    Raises MapError if the file cannot be read.
    """
    import cv2

    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
    try:
        bgr = read_image(path, flags if turned else flags | cv2.IMREAD_IGNORE_ORIENTATION)
        if bgr.dtype == np.uint16:
            bits = next(bits for bits in (10, 12, 14, 16) if bgr.max() < 2**bits)
            if bits < 16:
                _warn_once("%s: pixels are stored with 16 bits and read as %d", path.parent, bits)
            bgr = (bgr >> (bits - 8)).astype(np.uint8)
        elif bgr.dtype != np.uint8:
            raise ValueError(f"its pixels are {bgr.dtype}, neither of 8 nor of 16 bits")
    except (OSError, ValueError) as error:
        fix = "Convert it to JPEG or 8-bit PNG, remove it, or copy it again."
        raise MapError(f"cannot read this photograph: {error}", path=path, fix=fix) from error
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def exif_of(path: Path) -> dict[int, Any]:
    """Read the EXIF data of a photograph by tag; empty without, or if they are damaged."""
    try:
        with Image.open(path) as photograph:
            tags = photograph.getexif()
            return {**tags, **tags.get_ifd(0x8769)}
    except (OSError, ValueError, SyntaxError, struct.error):
        return {}


def quarters_upright(path: Path) -> int:
    """Return the quarter turns to the left that make a stored photograph upright by its EXIF orientation.

    4 for a mirrored one.
    """
    orientation = exif_of(path).get(0x0112, 1)
    return {1: 0, 3: 2, 6: 3, 8: 1}.get(orientation, 4 if orientation in (2, 4, 5, 7) else 0)


def exif_focal_px(path: Path) -> float | None:
    """Read the focal length of a photograph in pixels of its stored size from its EXIF data; None without.

    As COLMAP, but a resolution of the sensor is that of the photograph as taken, `PixelXDimension` wide.
    """
    import pycolmap

    tags = exif_of(path)
    unit_mm = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}.get(tags.get(0xA210, 2), 25.4)
    focal_px = longer = 0.0
    try:
        with Image.open(path) as photograph:
            longer = max(photograph.size)
        taken = max(tags.get(0xA002, 0), tags.get(0xA003, 0)) or longer
        if not tags.get(0xA405):  # of 35 mm film, which COLMAP reads
            focal_px = float(tags[0x920A]) * float(tags[0xA20E]) / unit_mm * longer / taken
    except (OSError, KeyError, TypeError, ValueError, ZeroDivisionError):
        pass  # without a resolution of the sensor
    if not 0.1 * longer < focal_px < 100 * longer:
        try:
            with quiet_colmap():
                options = pycolmap.ImageReaderOptions(camera_model="SIMPLE_PINHOLE")
                camera = pycolmap.infer_camera_from_image(path, options)
        except (ValueError, RuntimeError):  # a format that COLMAP does not read
            return None
        focal_px = camera.mean_focal_length() if camera.has_prior_focal_length else 0.0
    return float(focal_px) if 0.1 * longer < focal_px < 100 * longer else None


def reduce_photograph(rgb: NDArray[np.uint8], max_side_px: int) -> NDArray[np.uint8]:
    """Reduce a photograph (H, W, 3) to `max_side_px` pixels along its longer side, if it is larger; 0 keeps its size."""
    import cv2

    height, width = rgb.shape[:2]
    ratio = max_side_px / max(height, width)
    if max_side_px == 0 or ratio >= 1:
        return rgb
    size = max(1, round(width * ratio)), max(1, round(height * ratio))
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class PhotographCameras:
    """Initial intrinsics of photographs."""

    cameras: list[Any]  # `pycolmap.Camera` of the reduced photographs, with ids from 1
    camera_of: NDArray[np.int64]  # (I,) each photograph's row in `cameras`
    given: bool  # whether the intrinsics stay fixed

    @property
    def n_known_focal(self) -> int:
        """Cameras whose focal length was given or is in the EXIF data."""
        return sum(bool(camera.has_prior_focal_length) for camera in self.cameras)


def photograph_cameras(
    folder: Path, names: list[str], full_sizes: NDArray[np.int64], sizes: NDArray[np.int64], config: PhotographsConfig
) -> PhotographCameras:
    """Initial intrinsics of photographs, given or from their EXIF data.

    Takes width and height (I, 2) of each photograph as captured, upright, and as mapped. Raises ConfigError if COLMAP
    has no such camera model, or intrinsics are given for photographs of different sizes.
    """
    different = np.unique(full_sizes, axis=0).tolist()
    if config.camera_params and len(different) > 1:
        fix = "Omit camera_params, or map the photographs of each size separately."
        raise ConfigError("camera_params are for photographs of one size", path=folder, value=different, fix=fix)
    rows: dict[Any, int] = {}
    cameras: list[Any] = []
    camera_of = []
    for name, full, (width, height) in zip(names, full_sizes.tolist(), sizes.tolist(), strict=True):
        camera = _camera(folder / name, full, config)
        shared = (str(Path(name).parent), *full, round(camera.mean_focal_length(), 3))
        row = rows.setdefault(shared if config.shared_camera else name, len(cameras))
        camera_of.append(row)
        if row == len(cameras):
            camera.camera_id = len(cameras) + 1
            camera.rescale(width, height)
            cameras.append(camera)
    return PhotographCameras(cameras, np.array(camera_of, dtype=np.int64), len(config.camera_params) > 0)


def _camera(path: Path, size: list[int], config: PhotographsConfig) -> Any:
    """Initial intrinsics of a photograph at full size: given, or by the focal length in its EXIF data."""
    import pycolmap

    model = config.camera_model
    width, height = size
    if config.camera_params:
        camera = pycolmap.Camera(**ColmapCamera(model, width, height, config.camera_params).record())
        camera.has_prior_focal_length = True
        return camera
    if model not in pycolmap.CameraModelId.__members__ or model == "INVALID":
        raise ConfigError("COLMAP has no such camera model", value=model, fix="For instance SIMPLE_RADIAL.")
    focal_px = exif_focal_px(path)
    assumed = 1.2 * max(width, height)  # as in COLMAP
    camera = pycolmap.Camera.create_from_model_name(0, model, focal_px or assumed, width, height)
    camera.has_prior_focal_length = focal_px is not None
    return camera
