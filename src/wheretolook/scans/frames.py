"""Frames of an RGB-D recording in one pinhole camera: colour, and depth registered to it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.geometry.camera import Camera, ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import Float
from wheretolook.io.depth import read_depth
from wheretolook.mapping.colmap_model import camera_of_model, colmap_poses, read_model, registered_names
from wheretolook.scans.config import RgbdConfig
from wheretolook.scans.depth_correction import DepthCorrection
from wheretolook.scans.layouts import FrameFiles, Skipped, find_layout, frame_files
from wheretolook.utils.errors import ConfigError, SceneError
from wheretolook.utils.images import image_size, read_image

SURVEY_STRIDE = 8  # pixels between the readings of each depth image that stay in memory
_MIN_READINGS = 0.02  # share of a depth image's pixels; with fewer it counts as without depth


@dataclass(frozen=True, eq=False)
class RgbdFrame:
    """One frame."""

    rgb: NDArray[np.uint8]  # (H, W, 3)
    depth_m: NDArray[np.float32]  # (H, W) along the optical axis of the colour camera; 0 where there is no reading


class Frames(Protocol):
    """Frames by index, read on access."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> RgbdFrame: ...


class RgbdFrames:
    """The usable frames of a recording, read from disk on access.

    `camera` is the pinhole that all are brought to, `cam_from_world` (F, 3, 4) its poses, `names` the paths of the
    colour images in the recording, `survey_m` (F, h, w) every 8th pixel of the depth images, `skipped` counts
    frames that were not used. `model` is the COLMAP model that gives the poses, if any. `depth_correction` is the
    identity until `correct_depths`.

    Raises SceneError if the recording is incomplete or its images are of another kind, MapError if the model cannot be
    read, ConfigError for invalid intrinsics.
    """

    def __init__(self, config: RgbdConfig, progress: bool = True) -> None:
        assert config.folder is not None
        self.folder = config.folder
        self.layout = find_layout(config.folder)
        self.model = None if config.model is None else read_model(config.model)
        frames, self.skipped = frame_files(self.folder, self.layout, need_poses=self.model is None)
        if self.model is not None:
            frames = _with_poses_of(self.model, config.model, frames, self.skipped)
        chosen = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), config.max_frames)).round().astype(int))
        frames = [frames[i] for i in chosen]
        self.depth_scale = config.depth_scale or self.layout.depth_scale
        frames = self._of_one_size(frames)
        self._set_cameras(config)
        self.depth_correction = DepthCorrection()
        self._frames: list[FrameFiles] = []
        survey = []
        for frame in tqdm(frames, desc="read frames", unit="frame", disable=not progress):
            depth = self._read_depth(frame.depth)
            if depth is None or _read(frame.color, cv2.IMREAD_REDUCED_COLOR_8) is None:
                self.skipped.add("with an image that cannot be read")
            elif (depth > 0).mean() < _MIN_READINGS:
                self.skipped.add("without depth")
            else:
                self._frames.append(frame)
                half = SURVEY_STRIDE // 2
                survey.append(self._registered(depth)[half::SURVEY_STRIDE, half::SURVEY_STRIDE])
        if not self._frames:
            fix = "Check that the depth images hold 16-bit distances, 0 where there is none."
            raise SceneError("no frame can be used", path=self.folder, value=self.skipped.describe(), fix=fix)
        self.survey_m = np.stack(survey)

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> RgbdFrame:
        frame = self._frames[index]
        image = _read(frame.color, cv2.IMREAD_COLOR)
        depth = self._read_depth(frame.depth)
        if image is None or depth is None:
            raise SceneError("an image vanished during the run", path=frame.color, fix="Run the stage again.")
        rgb = np.ascontiguousarray(image[:, :, ::-1], dtype=np.uint8)
        if self._undistort is not None:
            across, down = self._undistort
            rgb = np.asarray(cv2.remap(rgb, across, down, cv2.INTER_LINEAR), dtype=np.uint8)
        return RgbdFrame(rgb, self._registered(depth))

    def correct_depths(self, correction: DepthCorrection) -> None:
        """Apply a correction to the survey and to all depths read later."""
        self.depth_correction = correction
        self.survey_m = correction.apply(self.survey_m)

    @cached_property
    def names(self) -> list[str]:
        """Paths of the colour images in the recording."""
        return [frame.name for frame in self._frames]

    @cached_property
    def names_in_model(self) -> list[str]:
        """Names of the model's images that gave the poses."""
        return [frame.in_model for frame in self._frames]

    @cached_property
    def cam_from_world(self) -> Float:
        """Poses (F, 3, 4) of the colour camera."""
        poses = np.stack([frame.cam_from_world for frame in self._frames])
        if self.model is None:  # the recording's are the depth camera's
            poses[:, :, 3] += self._color_from_depth_m
        return poses

    def _of_one_size(self, frames: list[FrameFiles]) -> list[FrameFiles]:
        """Select frames whose images have the most frequent sizes; sets `_size` and `_depth_size`, width by height."""
        pairs = [(_size(frame.color), _size(frame.depth)) for frame in frames]
        sizes = [(color, depth) if color and depth else None for color, depth in pairs]
        readable = Counter(size for size in sizes if size is not None)
        if not readable:
            raise SceneError("no image can be read", path=self.folder, value=frames[0].name, fix="Copy it again.")
        most = readable.most_common(1)[0][0]
        self._size, self._depth_size = most
        for size in sizes:
            if size != most:
                self.skipped.add("with an image that cannot be read" if size is None else "of another size")
        return [frame for frame, size in zip(frames, sizes, strict=True) if size == most]

    def _set_cameras(self, config: RgbdConfig) -> None:
        layout = self.layout
        source: Camera
        if self.model is not None:
            assert config.model is not None
            source = camera_of_model(self.model, config.model)
            if config.camera:
                fix = "Leave scenes.rgbd.camera out."
                raise ConfigError("the model gives the camera", value=config.camera, fix=fix)
            if (source.width, source.height) != self._size:
                problem = "the model's camera has another size than the colour images"
                fix = "Give a model of these images in their full size."
                raise SceneError(problem, path=config.model, value=((source.width, source.height), self._size), fix=fix)
        else:
            source = _pinhole(config.camera or _scaled(layout.camera, self._size), self._size)
        self.camera = source if isinstance(source, PinholeCamera) else _without_distortion(source)
        self._undistort = None if isinstance(source, PinholeCamera) else _undistortion(source, self.camera)
        depth_camera = config.depth_camera or (layout.depth_camera and _scaled(layout.depth_camera, self._depth_size))
        if not depth_camera:
            if self._depth_size != self._size:
                problem = "the depth images have another size than the colour images they are registered to"
                fix = "Give the depth images' own intrinsics: --scenes.rgbd.depth_camera '[fx, fy, cx, cy]'."
                raise SceneError(problem, path=self.folder, value=(self._depth_size, self._size), fix=fix)
            self._depth_camera = source
        else:
            self._depth_camera = _pinhole(depth_camera, self._depth_size)
        moved = config.color_from_depth_m or layout.color_from_depth_m
        self._color_from_depth_m = np.array(moved, dtype=np.float64)

    def _read_depth(self, path: Path) -> NDArray[np.float32] | None:
        """Metres along the depth camera's axis, 0 without a reading; None if the file is damaged."""
        try:
            return self.depth_correction.apply(read_depth(path, self.depth_scale))
        except (OSError, ValueError):
            return None

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
        width, height = self._depth_size
        pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
        rays = self._depth_camera.unproject(pixels)
        return np.asarray(np.nan_to_num(rays / rays[..., 2:]), dtype=np.float32)


def _with_poses_of(model: Any, path: Path | None, frames: list[FrameFiles], skipped: Skipped) -> list[FrameFiles]:
    """The frames that a COLMAP model has by the name of the colour image, or by its last part, with its poses."""
    poses = dict(zip(registered_names(model).values(), colmap_poses("", model), strict=True))
    by_last = dict[str, list[str]]()
    recorded = Counter(_last(frame.name) for frame in frames)
    for name in poses:
        by_last.setdefault(_last(name), []).append(name)
    found = []
    for frame in frames:
        alike = by_last.get(_last(frame.name), []) if recorded[_last(frame.name)] == 1 else []
        names = [frame.name] if frame.name in poses else alike
        if len(names) == 1:
            found.append(replace(frame, cam_from_world=poses[names[0]], in_model=names[0]))
        else:
            skipped.add("without a pose in the model")
    if not found:
        value = (next(iter(poses)), frames[0].name)
        fix = "Give the model that was made of these colour images."
        raise SceneError("the model has none of the recording's colour images", path=path, value=value, fix=fix)
    return found


def _last(name: str) -> str:
    return name.rpartition("/")[2]


def _size(path: Path) -> tuple[int, int] | None:
    """Width and height of an image; None if it cannot be read."""
    try:
        return image_size(path)
    except (OSError, ValueError):
        return None


def _read(path: Path, flags: int) -> NDArray[Any] | None:
    """An image; None if it cannot be read."""
    try:
        return read_image(path, flags)
    except (OSError, ValueError):
        return None


def _scaled(intrinsics: tuple[float, ...], size: tuple[int, int]) -> tuple[float, ...]:
    """A layout's intrinsics, which are of 640 x 480 pixels, for images of another size."""
    x = size[0] / 640
    y = size[1] / 480
    return intrinsics[0] * x, intrinsics[1] * y, intrinsics[2] * x, intrinsics[3] * y


def _pinhole(intrinsics: tuple[float, ...], size: tuple[int, int]) -> PinholeCamera:
    fx, fy, cx, cy = intrinsics
    return PinholeCamera(*size, fx, fy, (cx, cy))


def _without_distortion(source: ColmapCamera) -> PinholeCamera:
    return PinholeCamera(source.width, source.height, source.mean_focal_px, center_px=source.principal_point)


def _undistortion(source: ColmapCamera, pinhole: PinholeCamera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where a pixel of the pinhole is in the source's image, as OpenCV counts: the centre of the first pixel is 0."""
    pixels = np.stack(np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5), axis=-1)
    at = np.nan_to_num(source.project(pinhole.unproject(pixels)) - 0.5, nan=-1.0).astype(np.float32)
    return np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
