"""Reads depth images that belong to the images of a COLMAP model."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import Camera, PinholeCamera, cameras_by_id
from wheretolook.geometry.poses import transform
from wheretolook.geometry.tsdf import DepthImage
from wheretolook.mapping.colmap_model import read_model
from wheretolook.utils.errors import SceneError, check_positive
from wheretolook.utils.files import load_npy, read_image


def read_depth(path: Path, scale: float = 1000.0) -> NDArray[np.float32]:
    """Read a depth image (H, W) in metres, 0 without a reading: PNG or TIFF (integers of `scale` a metre, or floats in
    metres) or NPY (metres).

    Raises OSError or ValueError if the file is missing or damaged, SceneError if its values are no depths.
    """
    is_array = path.suffix.lower() == ".npy"
    image = load_npy(path) if is_array else read_image(path, cv2.IMREAD_UNCHANGED, 25_000_000)  # phones have half of it
    if image.ndim != 2 or image.dtype.kind not in "fui" or image.dtype.itemsize == 1:
        value = f"{image.dtype}, shape {image.shape}"
        raise SceneError("this is no depth image", path=path, value=value, fix="Write one channel of 16 bits as PNG.")
    depth_m = image.astype(np.float32) / np.float32(1.0 if image.dtype.kind == "f" else scale)
    if image.dtype == np.uint16:  # several cameras mark pixels without a reading so, all of them by 0
        depth_m[image == np.iinfo(np.uint16).max] = 0
    return depth_m


def read_depth_images(model: Path, folder: Path, scale: float = 1000.0) -> list[DepthImage]:
    """Read the depth images of a COLMAP model's images from a folder (see `read_depth` for formats and `scale`).

    A depth image has the name of its image, apart from the ending and with "depth" in place of "color" or "rgb" if
    need be. It is registered to the image and may have another size; distortion is removed. Raises a SceneError if
    there are none or one cannot be read.
    """
    reconstruction = read_model(model)
    cameras = cameras_by_id(reconstruction.cameras, model)
    rectify = cache(_rectified)
    images = []
    for image, depth_m in _depth_of_images(reconstruction, folder, scale):
        camera, shown = rectify(cameras[image.camera_id], depth_m.shape[::-1])
        if shown is not None:
            depth_m = np.append(depth_m, np.float32(0))[shown]
        images.append(DepthImage(depth_m, camera, image.cam_from_world().matrix()))
    if not images:
        fix = "Name each as its image, with the ending of a depth image, such as .png."
        raise SceneError("no depth image belongs to an image of the map", path=folder, fix=fix)
    return images


def metres_per_unit(model: Path, folder: Path, scale: float = 1000.0) -> float | None:
    """Return the metres in a unit of a COLMAP model by its depth images; arguments are those of `read_depth_images`.

    It is the median ratio of the depth at keypoints to that of their landmarks, of up to 50 images; None
    if no keypoint of a landmark has a depth.
    """
    reconstruction = read_model(model)
    step = -(-reconstruction.num_images() // 50)
    ratios = []
    for image, depth_m in _depth_of_images(reconstruction, folder, scale, step):
        observed = image.get_observation_points2D()
        if not observed:
            continue
        points = np.array([reconstruction.points3D[point.point3D_id].xyz for point in observed])
        depth = transform(image.cam_from_world().matrix(), points)[:, 2]
        size = (image.camera.width, image.camera.height)
        pixels = np.array([point.xy for point in observed]) / size * depth_m.shape[::-1]
        column, row = np.clip(pixels.astype(np.int64), 0, np.array(depth_m.shape[::-1]) - 1).T
        known = (depth_m[row, column] > 0) & (depth > 0)
        ratios.append(depth_m[row, column][known] / depth[known])
    found = np.concatenate(ratios) if ratios else np.empty(0)
    return float(np.median(found)) if len(found) else None


def _depth_of_images(
    reconstruction: Any, folder: Path, scale: float, step: int = 1
) -> Iterator[tuple[Any, NDArray[np.float32]]]:
    """Yield every step-th image of a model that has a depth image, and its depth (H, W) in metres."""
    check_positive("the number of units of depth images in a metre", scale)
    files = {p.relative_to(folder).with_suffix("").as_posix(): p for p in sorted(folder.rglob("*")) if p.is_file()}
    for _, image in sorted(reconstruction.images.items())[::step]:
        stem = Path(image.name).with_suffix("").as_posix()
        stems = [*({stem.replace(word, "depth") for word in ("color", "colour", "rgb")} - {stem}), stem]
        path = next((files[name] for name in stems if name in files), None)
        if path is not None and image.has_pose:
            try:
                depth_m = read_depth(path, scale)
            except (OSError, ValueError) as error:
                problem = f"cannot read the depth image: {error}"
                raise SceneError(problem, path=path, fix="Export it again.") from error
            yield image, depth_m


def _rectified(camera: Camera, shape: tuple[int, ...]) -> tuple[PinholeCamera, NDArray[np.int64] | None]:
    """Return the pinhole of a camera's rectified images of another width and height, and the pixel that each one shows.

    These are (height, width) rows of the flat image, width * height outside of it; None for a camera without distortion.
    """
    width, height = shape
    is_pinhole = isinstance(camera, PinholeCamera) or camera.model in ("SIMPLE_PINHOLE", "PINHOLE")
    fx = fy = camera.mean_focal_px
    if is_pinhole:
        fx, fy = np.diag(camera.matrix)[:2].tolist()
    size = np.array([width, height])
    scale = size / (camera.width, camera.height)
    cx, cy = (scale * camera.principal_point).tolist()
    pinhole = PinholeCamera(width, height, float(fx * scale[0]), float(fy * scale[1]), (cx, cy))
    if is_pinhole:
        return pinhole, None
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) + 0.5
    at = camera.project(pinhole.unproject(pixels)) * scale
    inside = np.asarray(((at >= 0) & (at < size)).all(axis=-1))
    column, row = np.moveaxis(np.where(inside[..., None], at, 0).astype(np.int64), -1, 0)
    return pinhole, np.where(inside, row * width + column, width * height)
