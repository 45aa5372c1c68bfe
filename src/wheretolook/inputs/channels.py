"""Names of the channels of bins and the attributes of landmarks, for options without PyTorch."""

from __future__ import annotations

from typing import Literal

from wheretolook.mapping.landmarks import MAP_ATTRIBUTES

CHANNELS = ("u", "v", "x", "y", "z")
"""Channels of every landmark: pixel (u, v) and position (x, y, z) in the camera frame in metres."""

POSE_ATTRIBUTES = ("across", "down", "distance", "mapped_angle", "distance_ratio", "pixel_angle", "pixel_size_ratio")
"""Attributes of a landmark in a view: x/z and y/z in the camera; the logarithm of the distance in metres; the cosine
between the ray from the camera and the mean direction it was mapped from; the logarithm of the distance over the mean
mapping distance; the logarithm of the angle of a pixel of the camera, one over its focal length in pixels; and the
logarithm of a pixel's size on the landmark's surface, over that in the mapping images."""

ATTRIBUTES = POSE_ATTRIBUTES + MAP_ATTRIBUTES
"""All attributes of a landmark in a view."""

OF_SIZE = ("distance", "mapped_distance", "mapped_pixel_size")
"""Attributes that depend on the size of a scene, logarithms of metres. Matching does not depend on it, so models of
detection probability ignore them by default."""

LANDMARK_CHANNELS = ("mapped_angle", "distance_ratio", *MAP_ATTRIBUTES)
"""Channels of landmarks' attributes, on request only: two of `POSE_ATTRIBUTES`, and those of the map. A bin's mean is
NaN where one of its landmarks' values is unknown."""

ALL_CHANNELS = CHANNELS + LANDMARK_CHANNELS

PAPER_VARIANTS: dict[str, tuple[str, ...]] = {
    "2d": ("u", "v"),
    "2d+z": ("u", "v", "z"),
    "2d+3d": ("u", "v", "x", "y", "z"),
}
"""The paper's inputs by name: 1,800, 2,700 and 4,500 values at 30 x 30 bins (its "4220" is a stale number)."""

Layout = Literal["in_place", "compact"]
"""Order of the bins in a flat input: each at its place, or filled bins first as in the paper's released code."""
