"""Which cameras a learned method serves: those with the field of view that it was trained with."""

from __future__ import annotations

import numpy as np

from wheretolook.geometry.camera import Camera, ColmapCamera, PinholeCamera
from wheretolook.utils.errors import WeightsError

FIELD_OF_VIEW_TOLERANCE = 1e-3
"""Relative difference in width / focal length and height / focal length up to which fields of view are the same."""


def check_field_of_view(trained: PinholeCamera, camera: Camera) -> None:
    """Raise a WeightsError if a camera's field of view is not that of the camera of the training views."""
    if not same_field_of_view(trained, camera):
        raise WeightsError(
            f"the network was trained for a camera of {_describe(trained)}",
            value=_describe(camera),
            fix="Use a pinhole camera with that field of view, or train with this one.",
        )


def same_field_of_view(trained: PinholeCamera, camera: Camera) -> bool:
    """Whether weights trained for one camera serve another: image and focal length of the same proportions."""
    if isinstance(camera, ColmapCamera):
        return False
    spans = np.array([(one.width / one.focal_px, one.height / one.focal_px) for one in (trained, camera)])
    return bool(np.allclose(spans[0], spans[1], rtol=FIELD_OF_VIEW_TOLERANCE, atol=0))


def _describe(camera: Camera) -> str:
    if isinstance(camera, ColmapCamera):
        return f"{camera.width} x {camera.height} px, {camera.model}"
    across, down = (2 * np.degrees(np.arctan(side / 2 / camera.focal_px)) for side in (camera.width, camera.height))
    return f"{camera.width} x {camera.height} px, {across:.1f} x {down:.1f} degrees"
