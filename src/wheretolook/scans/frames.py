"""Frames of an RGB-D recording in one pinhole camera: colour, and depth registered to it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.geometry.camera import Camera, PinholeCamera
from wheretolook.geometry.poses import Float
from wheretolook.geometry.tsdf import DepthImage
from wheretolook.io.depth import read_depth
from wheretolook.mapping.colmap_model import camera_of_model, colmap_poses, read_model, registered_names
from wheretolook.scans.config import RgbdConfig
from wheretolook.scans.depth_correction import DepthCorrection
from wheretolook.scans.layouts import FrameFiles, find_layout, frame_files
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.utils.images import image_size, read_image

SURVEY_STRIDE = 8  # pixels between the readings of each depth image that stay in memory
_MIN_READINGS = 0.02  # share of a depth image's pixels; with fewer it counts as without depth
_DAMAGED = "with an image that cannot be read"

T = TypeVar("T")


class RgbdFrames:
    """The usable frames of a recording by index, read from disk on access.

    `camera` is the pinhole that all are brought to, `names` the paths of the colour images in the recording,
    `names_in_model` those of the model's images that gave the poses, `survey_m` (F, h, w) every 8th pixel of the depth
    images, `skipped` counts frames that were not used. `model` is the COLMAP model that gives the poses, if any.
    `depth_correction` is the identity until `correct_depths`.

    Raises SceneError if the recording is incomplete or its images are of another kind, MapError if the model cannot be
    read, ConfigError for invalid intrinsics.
    """

    def __init__(self, config: RgbdConfig) -> None:
        assert config.folder is not None
        self.folder = config.folder
        self.layout = find_layout(config.folder)
        self.model = None if config.model is None else read_model(config.model)
        files, self.skipped = frame_files(self.folder, self.layout, need_poses=self.model is None)
        if self.model is not None:
            files = _with_poses_of(self.model, config.model, files, self.skipped)
        files = self._of_one_size([files[i] for i in evenly(len(files), config.max_frames)])
        self.depth_scale = config.depth_scale or self.layout.depth_scale
        self.depth_correction = DepthCorrection()
        self._set_cameras(config)
        self._files: list[FrameFiles] = []
        survey = []
        for frame in tqdm(files, desc="read frames", unit="frame"):
            depth_m = _read(self._read_depth, frame)
            if depth_m is None or _read(read_image, frame.color, cv2.IMREAD_REDUCED_COLOR_8) is None:
                self.skipped[_DAMAGED] += 1
            elif (depth_m > 0).mean() < _MIN_READINGS:
                self.skipped["without depth"] += 1
            else:
                self._files.append(frame)
                half = SURVEY_STRIDE // 2
                survey.append(self._registered(depth_m)[half::SURVEY_STRIDE, half::SURVEY_STRIDE])
        if not self._files:
            fix = "Check that the depth images hold 16-bit distances, 0 where there is none."
            raise SceneError("no frame can be used", path=self.folder, value=dict(self.skipped), fix=fix)
        self.survey_m = np.stack(survey)
        self.names = [frame.name for frame in self._files]
        self.names_in_model = [frame.name_in_model for frame in self._files]

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: int) -> DepthImage:
        depth_m = self._registered(self._read_depth(self._files[index]))
        return DepthImage(depth_m, self.camera, self.cam_from_world[index], self.rgb(index))

    def rgb(self, index: int) -> NDArray[np.uint8]:
        """Read the colours (H, W, 3) of a frame."""
        image = read_image(self._files[index].color, cv2.IMREAD_COLOR)
        rgb = np.ascontiguousarray(image[:, :, ::-1], dtype=np.uint8)
        if self._undistortion is not None:
            across, down = self._undistortion
            rgb = np.asarray(cv2.remap(rgb, across, down, cv2.INTER_LINEAR), dtype=np.uint8)
        return rgb

    def correct_depths(self, correction: DepthCorrection) -> None:
        """Apply a correction to the survey and to all depths read later."""
        self.depth_correction = correction
        self.survey_m = correction.apply(self.survey_m)

    @cached_property
    def cam_from_world(self) -> Float:
        """Poses (F, 3, 4) of the colour camera."""
        poses = np.stack([frame.cam_from_world for frame in self._files])
        if self.model is None:  # the recording's are the depth camera's
            poses[:, :, 3] += self._color_from_depth_m
        return poses

    def _of_one_size(self, frames: list[FrameFiles]) -> list[FrameFiles]:
        """Select frames whose images have the most frequent sizes; sets `_size` and `_depth_size`, width by height."""
        sizes = [(_read(image_size, frame.color), _read(image_size, frame.depth)) for frame in frames]
        readable = Counter(size for size in sizes if None not in size)
        if not readable:
            raise SceneError("no image can be read", path=self.folder, value=frames[0].name, fix="Copy it again.")
        ((most, _),) = readable.most_common(1)
        color, depth = most
        assert color is not None and depth is not None
        self._size = color
        self._depth_size = depth
        self.skipped.update(_DAMAGED if None in size else "of another size" for size in sizes if size != most)
        return [frame for frame, size in zip(frames, sizes, strict=True) if size == most]

    def _set_cameras(self, config: RgbdConfig) -> None:
        layout = self.layout
        source: Camera
        if self.model is None:
            source = _pinhole(config.camera or _scaled(layout.camera, self._size), self._size)
        elif config.camera:
            fix = "Leave scenes.rgbd.camera out."
            raise ConfigError("the model gives the camera", value=config.camera, fix=fix)
        else:
            assert config.model is not None
            source = camera_of_model(self.model, config.model)
            if (source.width, source.height) != self._size:
                problem = "the model's camera has another size than the colour images"
                fix = "Give a model of these images in their full size."
                raise SceneError(problem, path=config.model, value=((source.width, source.height), self._size), fix=fix)
        pinhole = PinholeCamera(*self._size, source.mean_focal_px, center_px=source.principal_point)
        self._undistortion = None
        if isinstance(source, PinholeCamera):
            pinhole = source
        else:  # where each pixel is in the image, as OpenCV counts: the centre of the first pixel is 0
            at = np.nan_to_num(source.project(pinhole.unproject(_pixels(*self._size))) - 0.5, nan=-1.0)
            self._undistortion = np.ascontiguousarray(np.moveaxis(at, -1, 0), dtype=np.float32)
        self.camera = pinhole
        self._depth_camera = source
        if depth_camera := config.depth_camera or _scaled(layout.depth_camera, self._depth_size):
            self._depth_camera = _pinhole(depth_camera, self._depth_size)
        elif self._depth_size != self._size:
            problem = "the depth images have another size than the colour images they are registered to"
            fix = "Give the depth images' own intrinsics: --scenes.rgbd.depth_camera '[fx, fy, cx, cy]'."
            raise SceneError(problem, path=self.folder, value=(self._depth_size, self._size), fix=fix)
        self._color_from_depth_m = np.array(config.color_from_depth_m or layout.color_from_depth_m, dtype=np.float64)

    def _read_depth(self, frame: FrameFiles) -> NDArray[np.float32]:
        """Read the corrected readings (h, w) of the depth camera, in metres."""
        return self.depth_correction.apply(read_depth(frame.depth, self.depth_scale))

    def _registered(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Register depth to the pinhole camera: the nearest reading that falls into each pixel."""
        if self._depth_camera == self.camera and not self._color_from_depth_m.any():
            return depth_m
        row, column = np.nonzero(depth_m)
        moved = self._color_from_depth_m.astype(np.float32)
        x, y, z = (self._depth_rays[row, column] * depth_m[row, column, None] + moved).T
        nearness = 1 / np.maximum(z, np.float32(1e-3))
        x = np.floor(x * nearness * np.float32(self.camera.fx) + np.float32(self.camera.cx))
        y = np.floor(y * nearness * np.float32(self.camera.fy) + np.float32(self.camera.cy))
        height = self.camera.height
        width = self.camera.width
        inside = (z > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        nearest = np.zeros(height * width, dtype=np.float32)
        np.maximum.at(nearest, (y[inside] * width + x[inside]).astype(np.int64), nearness[inside])
        with np.errstate(divide="ignore"):
            return np.where(nearest > 0, 1 / nearest, np.float32(0)).reshape(height, width)

    @cached_property
    def _depth_rays(self) -> NDArray[np.float32]:
        """Rays (h, w, 3) of the depth camera's pixels, of depth 1."""
        rays = self._depth_camera.unproject(_pixels(*self._depth_size))
        return np.asarray(np.nan_to_num(rays / rays[..., 2:]), dtype=np.float32)


def evenly(n: int, at_most: int) -> list[int]:
    """Return the indices of n items, or of `at_most` of them at even distances."""
    return np.unique(np.linspace(0, n - 1, min(n, at_most)).round().astype(int)).tolist()


def _with_poses_of(model: Any, path: Path | None, frames: list[FrameFiles], skipped: Counter[str]) -> list[FrameFiles]:
    """Return the frames that a COLMAP model has, with its poses.

    An image of the model has the name of the colour image, or its last part if one image of each has that.
    """
    poses = dict(zip(registered_names(model).values(), colmap_poses("", model), strict=True))
    recorded = Counter(_last(frame.name) for frame in frames)
    mapped = Counter(map(_last, poses))
    by_last = {_last(name): name for name in poses if mapped[_last(name)] == recorded[_last(name)] == 1}
    found = []
    for frame in frames:
        name = frame.name if frame.name in poses else by_last.get(_last(frame.name))
        if name is None:
            skipped["without a pose in the model"] += 1
        else:
            found.append(replace(frame, cam_from_world=poses[name], name_in_model=name))
    if not found:
        value = (next(iter(poses)), frames[0].name)
        fix = "Give the model that was made of these colour images."
        raise SceneError("the model has none of the recording's colour images", path=path, value=value, fix=fix)
    return found


def _last(name: str) -> str:
    return name.rpartition("/")[2]


def _read(read: Callable[..., T], *args: Any) -> T | None:
    """Call a reader of images; None if the image cannot be read."""
    try:
        return read(*args)
    except (OSError, ValueError):
        return None


def _scaled(intrinsics: tuple[float, ...], size: tuple[int, int]) -> tuple[float, ...]:
    """Scale intrinsics of 640 x 480 pixels, or none, to another size."""
    scales = (size[0] / 640, size[1] / 480) * 2
    return tuple(value * scale for value, scale in zip(intrinsics, scales, strict=False))


def _pinhole(intrinsics: tuple[float, ...], size: tuple[int, int]) -> PinholeCamera:
    fx, fy, cx, cy = intrinsics
    return PinholeCamera(*size, fx, fy, (cx, cy))


def _pixels(width: int, height: int) -> Float:
    """Centres (H, W, 2) of the pixels of an image."""
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
