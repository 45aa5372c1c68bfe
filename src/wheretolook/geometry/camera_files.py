"""Cameras in files of other programs: ROS's camera_info, OpenCV's FileStorage, nerfstudio's transforms.json."""

from __future__ import annotations

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
    if not path.is_file():
        return parse_camera(described)
    try:
        text = read_text(path)
        # OpenCV's first line and tags are no YAML; of several messages the first is read
        plain = re.sub(r"!!opencv\S+|\A(%YAML.*\n)?---\n", "", text).partition("\n---")[0]
        given = parse_json(text) if text.startswith("{") else parse_yaml(plain)
        return _camera({name.lower(): value for name, value in given.items()})
    except (OSError, ValueError, LookupError, TypeError, AttributeError, ConfigError) as error:
        fix = "Give ROS's camera_info, OpenCV's calibration with the image size, or transforms.json, of a calibrated camera."
        raise ConfigError(f"this file describes no camera: {error!r}", path=path, fix=fix) from error


def _camera(given: Mapping[str, Any]) -> Camera:
    """Return the camera of values by their names in a file, by the simplest model of COLMAP that has its distortion."""
    model = (
        given.get("distortion_model") or given.get("camera_model") or ("fisheye" if given.get("fisheye_model") else "")
    )
    if model not in PERSPECTIVE + FISHEYE:
        raise ValueError(f"unknown distortion model {model}")
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
                given.get("k", given.get("camera_matrix")),
                given.get("d", given.get("distortion_coefficients")),
            )
        )
        if not any(matrix):
            raise ValueError("the camera is not calibrated")
        if given.get("roi", {}).get("width", 0) not in (0, width):
            raise ValueError("a region of interest is not supported")
        # pixel (0, 0) of ROS and OpenCV is the centre of the top-left pixel
        pinhole = matrix[0], matrix[4], matrix[2] + 0.5, matrix[5] + 0.5
    for name, n in (
        (("OPENCV_FISHEYE", 4),) if model in FISHEYE else (("PINHOLE", 0), ("OPENCV", 4), ("FULL_OPENCV", 8))
    ):
        if not any(distortion[n:]):
            return camera_of(name, width, height, (*pinhole, *[*distortion, *[0] * n][:n]))
    raise ValueError(f"COLMAP has no model with the distortion {distortion}")
