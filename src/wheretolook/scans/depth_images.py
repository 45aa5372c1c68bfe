"""Reads depth images that belong to the images of a COLMAP model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wheretolook.geometry.camera import Camera, PinholeCamera, cameras_by_id
from wheretolook.io.depth import read_depth
from wheretolook.utils.errors import ConfigError, SceneError

if TYPE_CHECKING:
    from wheretolook.geometry.tsdf import DepthImage


def read_depth_images(model: Path, folder: Path, scale: float = 1000.0) -> list[DepthImage]:
    """Depth images of a COLMAP model's images, from a folder of PNG or TIFF (integers, `scale` a metre; floats, metres)
    or NPY files (metres).

    A depth image has the name of the image it belongs to but for the ending, in which "depth" may stand for "color" or
    "rgb". Its pixels lie on the image's: another size is that of the scaled camera, which must have no distortion.
    Raises a SceneError if there are none or one cannot be read, a ConfigError if the camera has distortion.
    """
    from wheretolook.geometry.tsdf import DepthImage
    from wheretolook.mapping.colmap_model import read_model

    if not folder.is_dir():
        raise SceneError("there is no such folder of depth images", path=folder, fix="Correct the path.")
    if not 0 < scale < np.inf:
        raise ConfigError("the scale of depth images is their unit's number in a metre", value=scale)
    found = read_model(model)
    cameras = cameras_by_id(found.cameras, model)
    files = {p.relative_to(folder).with_suffix("").as_posix(): p for p in sorted(folder.rglob("*")) if p.is_file()}
    images = []
    for number in sorted(found.images):
        image = found.images[number]
        stem = Path(image.name).with_suffix("").as_posix()
        stems = [stem, *(stem.replace(word, "depth") for word in ("color", "colour", "rgb"))]
        path = next((files[name] for name in stems if name in files), None)
        if path is not None and image.has_pose:
            try:
                values = read_depth(path, scale)
            except (OSError, ValueError) as error:
                problem = f"cannot read the depth image: {error}"
                raise SceneError(problem, path=path, fix="Export it again.") from error
            camera = _scaled(cameras[image.camera_id], values.shape[1], values.shape[0], path)
            images.append(DepthImage(values, camera, image.cam_from_world().matrix()))
    if not images:
        fix = f"Name them as the images of the map, such as {Path(found.images[min(found.images)].name).stem}.png."
        raise SceneError("no depth image belongs to an image of the map", path=folder, fix=fix)
    return images


def _scaled(camera: Camera, width: int, height: int, path: Path) -> PinholeCamera:
    try:
        matrix = camera.matrix
    except ConfigError as error:
        raise ConfigError(error.problem, path=path, value=error.value, fix=error.fix) from error
    across = width / camera.width
    down = height / camera.height
    center = (float(matrix[0, 2] * across), float(matrix[1, 2] * down))
    return PinholeCamera(width, height, float(matrix[0, 0] * across), float(matrix[1, 1] * down), center)
