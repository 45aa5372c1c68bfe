"""Names of what bins hold, apart from `wheretolook.inputs.bins` so that options can be read without PyTorch."""

from __future__ import annotations

from typing import Literal

from wheretolook.mapping.attribute_names import MAP_ATTRIBUTES

CHANNELS = ("u", "v", "x", "y", "z")
"""Channels of every landmark: pixel (u, v) and position (x, y, z) in the camera frame in metres."""

LANDMARK_CHANNELS = ("mapped_angle", "distance_ratio", *MAP_ATTRIBUTES)
"""Channels of what landmarks are like, on request only: two of `inputs.landmarks_in_view.POSE_ATTRIBUTES`, and what the
map knows. A bin's mean is NaN where one of its landmarks' values is not known."""

ALL_CHANNELS = CHANNELS + LANDMARK_CHANNELS

PAPER_VARIANTS: dict[str, tuple[str, ...]] = {
    "2d": ("u", "v"),
    "2d+z": ("u", "v", "z"),
    "2d+3d": ("u", "v", "x", "y", "z"),
}
"""The paper's inputs by name: 1,800, 2,700 and 4,500 values at 30 x 30 bins (its "4220" is a stale number)."""

Layout = Literal["in_place", "compact"]
"""Order of the bins in a flat input, see `wheretolook.inputs.bins.arrange`."""

INPUT_VARIANTS: dict[str, tuple[str, ...]] = {**PAPER_VARIANTS, "2d+3d+landmark": ALL_CHANNELS}
"""All inputs of the paper's network by name: the paper's own, and with what landmarks are like."""
