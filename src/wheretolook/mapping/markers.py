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
_SOFT_PX = 1.0  # residuals beyond this count less than by their square

MAX_ERROR_PX = 4.0
MAX_ERROR_SHARE = 1 / 400
"""A marker is refused if the root mean square reprojection error of its corners exceeds both this many pixels and this
share of the photographs' longer side. Corners are found to a fraction of a pixel; the error of a marker that was moved,
or printed twice, is tens of pixels."""


@dataclass(frozen=True, eq=False)
class MarkerView:
    """A marker as seen in a photograph with a known pose."""

    image: str  # the photograph's name
    camera: pycolmap.Camera
    cam_from_world: Float  # (3, 4)
    corners_px: Float  # (4, 2), clockwise from the marker's top left; (0.5, 0.5) is the centre of the top-left pixel


@dataclass(frozen=True, eq=False)
class Marker:
    """A marker placed in a map."""

    marker_id: int  # in its dictionary
    corners: Float  # (4, 3), world, in the map's units
    images: tuple[str, ...]  # names of the photographs that see it
    error_px: float  # root mean square reprojection error of its corners

    @property
    def sides(self) -> Float:
        """Lengths (4,) of the sides, in the map's units."""
        return np.asarray(np.linalg.norm(np.roll(self.corners, -1, axis=0) - self.corners, axis=1))

    @property
    def center(self) -> Float:
        """Mean of the corners, (3,), in the map's units."""
        return np.asarray(self.corners.mean(0))


def detect_markers(rgb: NDArray[np.uint8], dictionary: str, path: Path | None = None) -> dict[int, Float]:
    """Find the markers of a dictionary in a photograph (H, W, 3) uint8.

    Args:
        rgb: the photograph.
        dictionary: by OpenCV's name, such as DICT_4X4_50 or DICT_APRILTAG_36H11.
        path: of the photograph, for errors.

    Returns:
        Corners (4, 2) of each marker by its id, clockwise from its top left; (0.5, 0.5) is the centre of the top-left
        pixel.

    Raises:
        ConfigError: OpenCV has no such dictionary.
        MapError: two markers have the same id, so that one could not tell which is which in another photograph.
    """
    import cv2

    grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    corners, ids, _ = marker_detector(dictionary).detectMarkers(grey)
    numbers = [] if ids is None else np.asarray(ids).reshape(-1).tolist()
    if len(set(numbers)) < len(numbers):
        twice = next(number for number in numbers if numbers.count(number) > 1)
        fix = "Print every marker once, or choose the dictionary the markers are of."
        raise MapError(f"marker {twice} is twice in this photograph", path=path, value=numbers, fix=fix)
    refined = [refine_corners(grey, np.asarray(at, np.float64).reshape(4, 2)) for at in corners]
    return {number: at + 0.5 for number, at in zip(numbers, refined, strict=True)}  # OpenCV's pixel centres are whole


def place_marker(marker_id: int, views: Sequence[MarkerView]) -> Marker:
    """Place a marker's corners where the rays to them meet, by least reprojection error (robust: Huber-like).

    Raises:
        MapError: fewer than two photographs see the marker, or all from one direction; or no place fits all of them,
            for instance because the marker was moved or printed twice.
    """
    from scipy.optimize import least_squares

    images, again = tuple(view.image for view in views), "Take another photograph of it from another place."
    if len(views) < 2:
        problem = f"marker {marker_id} is seen in one photograph only, which says nothing of its distance"
        raise MapError(problem, value=" ".join(images), fix=again)
    start = np.stack([_meeting_point(views, corner) for corner in range(4)])
    centers = camera_centers(np.stack([view.cam_from_world for view in views]))
    rays = start.mean(0) - centers
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    angle_deg = max(np.degrees(np.arccos(np.clip(a @ b, -1, 1))) for a, b in itertools.combinations(rays, 2))
    if not angle_deg >= _LEAST_ANGLE_DEG:
        problem = f"the photographs see marker {marker_id} from one direction, {angle_deg:.1f} degrees apart at most"
        raise MapError(problem, value=" ".join(images), fix=again)

    def residuals(values: Float) -> Float:
        return np.concatenate([_reprojection(view, values.reshape(4, 3)).ravel() for view in views])

    found = least_squares(residuals, start.ravel(), loss="soft_l1", f_scale=_SOFT_PX, x_scale="jac")
    error_px = float(np.sqrt(2 * np.mean(residuals(found.x) ** 2)))
    limit_px = max(MAX_ERROR_PX, MAX_ERROR_SHARE * max(max(view.camera.width, view.camera.height) for view in views))
    if not error_px <= limit_px:
        misses = f"its corners miss by {error_px:.1f} px, more than {limit_px:.1f}"
        problem = f"no single place fits the photographs of marker {marker_id}, {misses}"
        fix = "Print every marker once, and leave out photographs from before it was moved."
        raise MapError(problem, value=" ".join(images), fix=fix)
    return Marker(marker_id, found.x.reshape(4, 3), images, error_px)


def _meeting_point(views: Sequence[MarkerView], corner: int) -> Float:
    """The point (3,) with the least sum of squared distances to the rays through a corner."""
    matrix, vector = np.zeros((3, 3)), np.zeros(3)
    for view in views:
        ray = np.asarray(view.camera.cam_ray_from_img(view.corners_px[corner][None]))[0] @ view.cam_from_world[:, :3]
        ray /= np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        matrix += across
        vector += across @ camera_centers(view.cam_from_world)
    return np.asarray(np.linalg.lstsq(matrix, vector, rcond=None)[0])


def _reprojection(view: MarkerView, corners: Float) -> Float:
    """Reprojection errors (4, 2) in pixels of corners (4, 3) in a view."""
    at = corners @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
    at[:, 2] = np.maximum(at[:, 2], 1e-9)  # lets the optimization return from behind the camera
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
