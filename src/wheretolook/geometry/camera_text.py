"""Cameras as a user writes them: a string of COLMAP's, or a field of view."""

from __future__ import annotations

from wheretolook.geometry.camera import Camera, PinholeCamera, camera_of
from wheretolook.utils.errors import ConfigError

EXAMPLE = "PINHOLE,640,480,320,320,320,240"


def parse_camera(text: str) -> Camera:
    """The camera of a text "MODEL,width,height,parameters", with COLMAP's models and order of parameters.

    Blanks may stand for commas, as in COLMAP's cameras.txt.

    Raises a ConfigError if it is none, or a model that projects nothing.
    """
    model, *numbers = text.replace(",", " ").split() or [""]
    fix = f"Write MODEL,width,height,parameters as COLMAP orders them, such as {EXAMPLE}; sizes in pixels."
    try:
        width, height, *params = (float(number) for number in numbers)
    except ValueError as error:
        raise ConfigError("this is no camera", value=text, fix=fix) from error
    if not width.is_integer() or not height.is_integer():
        raise ConfigError("an image's size is whole pixels", value=text, fix=fix)
    try:
        return camera_of(model.upper(), int(width), int(height), params)
    except ConfigError as error:
        raise ConfigError(error.problem, value=text, fix=error.fix or fix) from error


def camera_of_view(across_deg: float, size: tuple[int, int] = (640, 480)) -> PinholeCamera:
    """A pinhole of a horizontal field of view in degrees, and an image size (width, height) in pixels.

    Raises a ConfigError unless the angle is between 0 and 180 degrees.
    """
    return PinholeCamera.of_field_of_view(across_deg, *size)


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of a text such as "640x480"; a ConfigError if it is none."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise ConfigError("this is no image size", value=text, fix="Write it in pixels, such as 640x480.")
    return int(width), int(height)
