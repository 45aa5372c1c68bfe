"""Options of scenes from RGB-D recordings."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Literal

from wheretolook.utils.errors import ConfigError
from wheretolook.utils.validation import check_positive, check_range

UP_AXES = {"x": (1, 0, 0), "-x": (-1, 0, 0), "y": (0, 1, 0), "-y": (0, -1, 0), "z": (0, 0, 1), "-z": (0, 0, -1)}


@dataclass(frozen=True)
class RgbdConfig:
    """A scene from an RGB-D recording: colour images, depth images and poses.

    Args:
        folder: an RGB-D recording as of 7-Scenes or TUM. The former has frame-*.color.*,
            .depth.png and .pose.txt, also in folders seq-*, the latter rgb.txt, depth.txt and groundtruth.txt.
        name: name of the scene; the folder's own if empty.
        split: where its viewpoints go: train, val or test.
        model: COLMAP model of the colour images, whose poses and camera are taken instead of the recording's. The
            mesh is then in its frame, turned upright, and depths are checked against its landmarks.
        depth_scale: units of a depth image in a metre; 0 for the layout's, 1000 in 7-Scenes and 5000 in TUM.
        camera: fx, fy, cx, cy of the colour images in pixels; the layout's if empty.
        depth_camera: fx, fy, cx, cy of the depth images, if they are not registered to the colour images.
        color_from_depth_m: position of the depth camera in the colour camera's frame; x right, y down, z forward.
        correct_depth: with a model, bring depths to those of its landmarks: a structured-light camera is wrong
            by centimetres at far ones.
        up: direction up in its world. `auto`, x, y, z, one of these with a minus sign, or three numbers
            such as "0 -0.9 -0.4". `auto` estimates it from how the camera was held and from the surfaces.
        voxel_m: distance between two samples of the distance field. Finer ones need more memory and triangles.
        max_depth_m: farther readings are ignored, as depth cameras are too noisy there.
        max_frames: greatest number of frames; a longer recording is subsampled evenly.
        appearance: `texture` projects the sharpest colour image on each triangle, `colors` averages all at the
            vertices.
    """

    folder: Path | None = None
    name: str = ""
    split: Literal["train", "val", "test"] = "test"
    model: Path | None = None
    depth_scale: float = 0.0
    camera: tuple[float, ...] = ()
    depth_camera: tuple[float, ...] = ()
    color_from_depth_m: tuple[float, ...] = ()
    correct_depth: bool = True
    up: str = "auto"
    voxel_m: float = 0.01
    max_depth_m: float = 4.0
    max_frames: int = 1000
    appearance: Literal["texture", "colors"] = "texture"

    def __post_init__(self) -> None:
        for name, length in (("camera", 4), ("depth_camera", 4), ("color_from_depth_m", 3)):
            values = getattr(self, name)
            if len(values) not in (0, length) or not all(-inf < value < inf for value in values):
                raise ConfigError(f"scenes.rgbd.{name} are {length} numbers", value=values)
        check_range("scenes.rgbd.depth_scale", self.depth_scale, 0)
        for name in ("voxel_m", "max_depth_m", "max_frames"):
            check_positive(f"scenes.rgbd.{name}", getattr(self, name))
        _ = self.up_direction

    @property
    def scene_name(self) -> str:
        """Name of the scene's folder."""
        assert self.folder is not None
        return self.name or self.folder.resolve().name

    @property
    def up_direction(self) -> tuple[float, ...] | None:
        """Up in the recording's world, not of unit length; None for `auto`. Raises ConfigError if `up` is not a direction."""
        if self.up == "auto":
            return None
        if self.up in UP_AXES:
            return UP_AXES[self.up]
        try:
            direction = tuple(float(value) for value in self.up.replace(",", " ").split())
        except ValueError:
            direction = ()
        if len(direction) != 3 or not 0 < sum(value * value for value in direction) < inf:
            fix = f'Use auto, {", ".join(UP_AXES)}, or three numbers such as "0 -0.9 -0.4".'
            raise ConfigError("scenes.rgbd.up is no direction", value=self.up, fix=fix)
        return direction
