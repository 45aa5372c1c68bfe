"""Read photographs, upright and reduced, and the intrinsics of their cameras."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import ColmapCamera
from wheretolook.mapping.config import PhotographsConfig
from wheretolook.utils.errors import ConfigError, MapError
from wheretolook.utils.files import read_image
from wheretolook.utils.texts import LOG, quiet_colmap

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")


def list_photographs(folder: Path) -> list[str]:
    """List photographs in a folder and its subfolders by relative name, without depth images (PNG, 16-bit grey).

    Raises MapError if there are fewer than two, or a name is not in UTF-8, which COLMAP needs.
    """
    if not folder.is_dir():
        raise MapError("there is no such folder", path=folder, fix="Give the folder of the photographs.")
    files = [path for path in folder.rglob("*") if path.is_file() and path.suffix.lower() in SUFFIXES]
    n_files = len(files)
    files = [path for path in files if not _is_depth_image(path)]
    if len(files) < n_files:
        LOG.warning("%s: %d depth images (PNG, 16-bit grey) are left out", folder, n_files - len(files))
    names = sorted(path.relative_to(folder).as_posix() for path in files)
    for name in names:
        if name != name.encode(errors="replace").decode():
            raise MapError("the name of a photograph is not in UTF-8", path=folder, value=name, fix="Rename it.")
    if len(names) < 2:
        fix = f"Files that end in {', '.join(SUFFIXES)} count."
        raise MapError("a map needs at least two photographs", path=folder, value=len(names), fix=fix)
    return names


def _is_depth_image(path: Path) -> bool:
    """Return whether a file is a PNG of one channel with 16 bits, by its header."""
    if path.suffix.lower() != ".png" or not os.access(path, os.R_OK):
        return False
    with path.open("rb") as file:
        return file.read(26)[24:] == b"\x10\x00"


def read_photograph(path: Path, turned: bool = True) -> NDArray[np.uint8]:
    """Read a photograph (H, W, 3) uint8 RGB, turned upright by its EXIF orientation, or as stored.

    Raises MapError if the file cannot be read.
    """
    import cv2

    try:
        bgr = read_image(path, cv2.IMREAD_COLOR if turned else cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except (OSError, ValueError) as error:
        fix = "Remove it, or copy it again."
        raise MapError(f"cannot read this photograph: {error}", path=path, fix=fix) from error
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), dtype=np.uint8)


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


def photograph_pairs(n: int, exhaustive_up_to: int, overlap: int) -> NDArray[np.int64]:
    """Choose pairs (P, 2) of n photographs to match, i < j: all pairs, if n does not exceed `exhaustive_up_to`.

    Otherwise each with the `overlap` that follow it and as many at distances that double, as COLMAP's sequential
    matching does. This needs no vocabulary tree, but names in the order of capture.
    """
    if n <= exhaustive_up_to:
        return np.column_stack(np.triu_indices(n, 1)).astype(np.int64)
    steps = sorted({*range(1, overlap + 1), *(2**power for power in range(overlap))})
    return np.array([(i, i + step) for i in range(n) for step in steps if i + step < n], dtype=np.int64)


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
    try:
        with quiet_colmap():
            inferred = pycolmap.infer_camera_from_image(path, pycolmap.ImageReaderOptions(camera_model=model))
    except (ValueError, RuntimeError) as error:
        raise MapError(f"cannot read this photograph: {error}", path=path, fix="Remove it.") from error
    camera = pycolmap.Camera.create_from_model_name(0, model, inferred.mean_focal_length(), width, height)
    camera.has_prior_focal_length = inferred.has_prior_focal_length
    return camera
