"""Cameras in files of other programs: ROS's camera_info, OpenCV's FileStorage, nerfstudio's transforms.json."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from wheretolook.geometry.camera import Camera, camera_of, parse_camera
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import parse_json, parse_yaml, read_text

PERSPECTIVE = ("", "plumb_bob", "rational_polynomial", "OPENCV", "PINHOLE", "SIMPLE_PINHOLE")
FISHEYE = ("equidistant", "fisheye", "OPENCV_FISHEYE")
"""Names of distortion models whose coefficients are those of OpenCV's perspective or fisheye camera."""


def read_camera(described: str) -> Camera:
    """Return the camera of a text, see `parse_camera`, or of the file that it names.

    Files are YAML of ROS (also `ros2 topic echo` of a camera_info) or OpenCV, or nerfstudio's JSON. Raises ConfigError if
    there is no camera, or one that is not calibrated or that COLMAP has no model for.
    """
    path = Path(described)
    if not os.path.isfile(described):
        if described.lower().endswith((".yaml", ".yml", ".json", ".txt")):
            raise ConfigError("there is no such file", path=path, fix="Correct the path of the camera's file.")
        return parse_camera(described)
    try:
        text = read_text(path)
        # OpenCV's first line and tags are no YAML; of several messages the first is read
        plain = re.sub(r"!!opencv\S+|\A(%YAML.*\n)?---\n", "", text).partition("\n---")[0]
        given = parse_json(text) if text.lstrip().startswith("{") else parse_yaml(plain)
        if not isinstance(given, dict):
            raise ValueError("it has no names with values")
        return _camera({str(name).lower(): value for name, value in given.items()})
    except (OSError, ValueError, LookupError, TypeError, AttributeError, ConfigError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else error
        fix = "Give ROS's camera_info, OpenCV's calibration with the image size, or transforms.json, of a calibrated camera."
        raise ConfigError(f"this file describes no camera: {reason}", path=path, fix=fix) from error


def _camera(given: Mapping[str, Any]) -> Camera:
    """Return the camera of values by their names in a file, by the simplest model of COLMAP that has its distortion."""
    is_fisheye = given.get("fisheye_model") or given.get("is_fisheye")
    model = "fisheye" if is_fisheye else given.get("distortion_model") or given.get("camera_model") or ""
    if model not in PERSPECTIVE + FISHEYE:
        raise ValueError(f"unknown distortion model {model}")
    if "frames" in given and "fl_x" not in given:
        raise ValueError("the intrinsics fl_x, w and h must be above frames, the same for all")
    if "fl_x" in given:  # nerfstudio; its k4 is of the eighth order, which no model has
        width, height, fx = given["w"], given["h"], given["fl_x"]
        pinhole = fx, given.get("fl_y", fx), given.get("cx", width / 2), given.get("cy", height / 2)
        names = "k1 k2 k3 k4" if model in FISHEYE else "k1 k2 p1 p2 k3 - - - k4"
        distortion = [given.get(name, 0) for name in names.split()]
    else:
        width, height = (given.get(side) or given[f"image_{side}"] for side in ("width", "height"))
        matrix, distortion = (
            np.array(value["data"] if isinstance(value, dict) else value, dtype=float).ravel().tolist()
            for value in (
                given["k"] if "k" in given else given["camera_matrix"],
                given.get("d", given.get("distortion_coefficients")) or [],
            )
        )
        if not any(matrix):
            raise ValueError("the camera is not calibrated")
        if len(matrix) != 9:
            raise ValueError(f"a camera matrix has 9 numbers, not {len(matrix)}")
        roi = given.get("roi") or {}
        is_part = roi.get("width", 0) not in (0, width) or roi.get("height", 0) not in (0, height)
        if is_part or max(given.get("binning_x", 0), given.get("binning_y", 0)) > 1:
            raise ValueError("binning or a region of interest is not supported")
        # pixel (0, 0) of ROS and OpenCV is the centre of the top-left pixel
        pinhole = matrix[0], matrix[4], matrix[2] + 0.5, matrix[5] + 0.5
    if float(width).is_integer() and float(height).is_integer():
        width, height = map(int, (width, height))
    for name, n in (
        (("OPENCV_FISHEYE", 4),) if model in FISHEYE else (("PINHOLE", 0), ("OPENCV", 4), ("FULL_OPENCV", 8))
    ):
        if not any(distortion[n:]):
            return camera_of(name, width, height, (*pinhole, *[*distortion, *[0] * n][:n]))
    raise ValueError(f"COLMAP has no model with the distortion {distortion}")
