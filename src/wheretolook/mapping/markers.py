"""ArUco and AprilTag markers: found in photographs by OpenCV, their corners placed in a map."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.mapping.marker_corners import refine_corners
from wheretolook.utils.errors import ConfigError, MapError

if TYPE_CHECKING:
    import pycolmap

_LEAST_ANGLE_DEG = 1.5  # between two rays to a marker, as for landmarks
_SOFT_PX = 1.0

MAX_ERROR_PX = 4.0
MAX_ERROR_SHARE = 1 / 400
"""A marker is refused whose corners miss those seen by more pixels than this (root mean square), or by more than this
share of the photographs' longer side, whichever is larger. Corners are found to a fraction of a pixel; a marker that
was moved, or printed twice, misses by tens."""


@dataclass(frozen=True, eq=False)
class MarkerView:
    """A marker in a photograph with a pose.

    Attributes:
        image: the photograph's name.
        camera: `pycolmap.Camera` of the photograph.
        cam_from_world: (3, 4).
        corners_px: (4, 2), clockwise from the marker's top left; (0.5, 0.5) is the centre of the top-left pixel.
    """

    image: str
    camera: pycolmap.Camera
    cam_from_world: Float
    corners_px: Float


@dataclass(frozen=True, eq=False)
class Marker:
    """A marker placed in a map.

    Attributes:
        marker_id: in its dictionary.
        corners: (4, 3), world, in the map's units.
        images: names of the photographs that see it.
        error_px: root mean square reprojection error of its corners.
    """

    marker_id: int
    corners: Float
    images: tuple[str, ...]
    error_px: float

    @property
    def sides(self) -> Float:
        """Lengths (4,) of the sides, in the map's units."""
        lengths: Float = np.linalg.norm(np.roll(self.corners, -1, axis=0) - self.corners, axis=1)
        return lengths

    @property
    def center(self) -> Float:
        """Mean of the corners, (3,), in the map's units."""
        middle: Float = self.corners.mean(0)
        return middle


def detect_markers(rgb: NDArray[np.uint8], dictionary: str, path: Path | None = None) -> dict[int, Float]:
    """Find the markers of a dictionary in a photograph.

    Args:
        rgb: (H, W, 3) uint8.
        dictionary: by OpenCV's name, such as DICT_4X4_50 or DICT_APRILTAG_36H11.
        path: of the photograph, for errors.

    Returns:
        Corners (4, 2) of each marker by its id, clockwise from its top left; see `refine_corners`.

    Raises:
        ConfigError: OpenCV has no such dictionary.
        MapError: two markers have the same id: which is which in another photograph would be a guess.
    """
    import cv2

    grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    corners, ids, _ = marker_detector(dictionary).detectMarkers(grey)
    numbers = [] if ids is None else np.asarray(ids).reshape(-1).tolist()
    if len(set(numbers)) < len(numbers):
        twice = next(number for number in numbers if numbers.count(number) > 1)
        raise MapError(
            f"marker {twice} is twice in this photograph", path=path, value=numbers,
            fix="Print every marker once, or choose the dictionary the markers are of.",
        )  # fmt: skip
    refined = [refine_corners(grey, np.asarray(at, np.float64).reshape(4, 2)) for at in corners]
    return {number: at + 0.5 for number, at in zip(numbers, refined, strict=True)}  # OpenCV's pixel centres are whole


def place_marker(marker_id: int, views: Sequence[MarkerView]) -> Marker:
    """Place a marker's corners where the rays to them meet, by least reprojection error (robust: Huber-like).

    Raises:
        MapError: fewer than two photographs see it, or all from one direction; or no place fits what they see, as of
            a marker that was moved or printed twice.
    """
    from scipy.optimize import least_squares

    images = tuple(view.image for view in views)
    if len(views) < 2:
        raise MapError(
            f"marker {marker_id} is seen in one photograph only, which says nothing of its distance",
            value=" ".join(images), fix="Take another photograph of it from another place.",
        )  # fmt: skip
    start = np.stack([_meeting_point(views, corner) for corner in range(4)])
    centers = camera_centers(np.stack([view.cam_from_world for view in views]))
    rays = start.mean(0) - centers
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    angle_deg = max(np.degrees(np.arccos(np.clip(a @ b, -1, 1))) for a, b in itertools.combinations(rays, 2))
    if not angle_deg >= _LEAST_ANGLE_DEG:
        raise MapError(
            f"the photographs see marker {marker_id} from one direction, {angle_deg:.1f} degrees apart at most",
            value=" ".join(images), fix="Take another photograph of it from another place.",
        )  # fmt: skip

    def residuals(values: Float) -> Float:
        return np.concatenate([_reprojection(view, values.reshape(4, 3)).ravel() for view in views])

    found = least_squares(residuals, start.ravel(), loss="soft_l1", f_scale=_SOFT_PX, x_scale="jac")
    error_px = float(np.sqrt(2 * np.mean(residuals(found.x) ** 2)))
    limit_px = max(MAX_ERROR_PX, MAX_ERROR_SHARE * max(max(view.camera.width, view.camera.height) for view in views))
    if not error_px <= limit_px:
        raise MapError(
            f"no single place fits the photographs of marker {marker_id}, its corners miss by {error_px:.1f} px, more "
            f"than {limit_px:.1f}", value=" ".join(images),
            fix="Print every marker once, and leave out photographs from before it was moved.",
        )  # fmt: skip
    return Marker(marker_id, found.x.reshape(4, 3), images, error_px)


def _meeting_point(views: Sequence[MarkerView], corner: int) -> Float:
    """The point of least squared distance to the rays through a corner, (3,)."""
    matrix, vector = np.zeros((3, 3)), np.zeros(3)
    for view in views:
        ray = np.asarray(view.camera.cam_ray_from_img(view.corners_px[corner][None]))[0] @ view.cam_from_world[:, :3]
        ray /= np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        matrix += across
        vector += across @ camera_centers(view.cam_from_world)
    point: Float = np.linalg.lstsq(matrix, vector, rcond=None)[0]
    return point


def _reprojection(view: MarkerView, corners: Float) -> Float:
    """Pixels (4, 2) by which corners (4, 3) miss those seen."""
    at = corners @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
    at[:, 2] = np.maximum(at[:, 2], 1e-9)  # a corner that strays behind a camera must come back
    miss: Float = np.asarray(view.camera.img_from_cam(at)) - view.corners_px
    return np.nan_to_num(miss, nan=1e6)


@lru_cache(maxsize=4)
def marker_detector(dictionary: str) -> Any:
    """OpenCV's detector of a dictionary's markers.

    Raises:
        ConfigError: OpenCV has no such dictionary.
    """
    import cv2

    names = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
    if dictionary not in names:
        raise ConfigError("OpenCV has no such dictionary of markers", value=dictionary, fix=f"Use one of {names}.")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    return cv2.aruco.ArucoDetector(markers, parameters)
