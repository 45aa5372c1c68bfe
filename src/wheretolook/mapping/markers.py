"""Detect ArUco and AprilTag markers in photographs, with corners to hundredths of a pixel, and place them in a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.utils.errors import ConfigError, MapError

if TYPE_CHECKING:
    import pycolmap

_MIN_ANGLE_DEG = 1.5  # between two rays to a marker, as for landmarks
_SOFT_PX = 1.0  # larger residuals count less than quadratically
_ROUNDS = 3  # of fitting lines to the edges between the corners
_SAMPLES = 32  # profiles across an edge
_AWAY_FROM_CORNERS = 0.15  # share of an edge that is skipped at either end, where its neighbours blur into it
_STEPS_PER_PX = 4  # samples of a profile

# A marker is rejected if the root mean square reprojection error of its corners exceeds both this many pixels and this
# share of the photographs' longer side. That of a marker that was moved, or printed twice, is tens of pixels.
MAX_ERROR_PX = 4.0
MAX_ERROR_SHARE = 1 / 400


@dataclass(frozen=True, eq=False)
class MarkerView:
    """A view of a marker in a photograph with a known pose."""

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
    def name(self) -> str:
        """Name in reports."""
        return f"marker {self.marker_id}"

    @property
    def sides(self) -> Float:
        """Lengths (4,) of the sides, in the map's units."""
        return np.asarray(np.linalg.norm(np.roll(self.corners, -1, axis=0) - self.corners, axis=1))

    @property
    def center(self) -> Float:
        """Mean of the corners, (3,), in the map's units."""
        return np.asarray(self.corners.mean(0))


def detect_markers(rgb: NDArray[np.uint8], dictionary: str, path: Path | None = None) -> dict[int, Float]:
    """Detect markers in a photograph (H, W, 3) uint8: corners (4, 2) by id, clockwise from the marker's top left.

    (0.5, 0.5) is the centre of the top-left pixel. Raises ConfigError if OpenCV has no such dictionary, MapError if two
    markers have the same id, which would be ambiguous in other photographs.
    """
    import cv2

    grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    corners, ids, _ = marker_detector(dictionary).detectMarkers(grey)
    numbers = [] if ids is None else np.asarray(ids).reshape(-1).tolist()
    if len(set(numbers)) < len(numbers):
        fix = "Print every marker once, or choose the markers' dictionary."
        raise MapError("a marker appears twice in this photograph", path=path, value=sorted(numbers), fix=fix)
    refined = (refine_corners(grey, np.asarray(at, np.float64).reshape(4, 2)) for at in corners)
    # OpenCV counts pixels from the centre of the top-left one.
    return {number: at + 0.5 for number, at in zip(numbers, refined, strict=True)}


def place_marker(marker_id: int, views: Sequence[MarkerView]) -> Marker:
    """Place a marker's corners (4, 3) in the map, by least robust reprojection error over its views.

    Raises MapError if fewer than two photographs see the marker, all see it from one direction, or no position fits all
    of them, for instance because the marker was moved or printed twice.
    """
    from scipy.optimize import least_squares

    images = tuple(view.image for view in views)
    start = np.stack([_meeting_point(views, corner) for corner in range(4)])
    centers = camera_centers(np.stack([view.cam_from_world for view in views]))
    rays = start.mean(0) - centers
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    angle_deg = np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1)))
    if not angle_deg >= _MIN_ANGLE_DEG:
        problem = f"marker {marker_id} is in photographs from one direction only, {angle_deg:.1f} degrees apart at most"
        raise MapError(problem, value=" ".join(images), fix="Take another photograph of it from another place.")

    def residuals(values: Float) -> Float:
        return np.concatenate([_reprojection(view, values.reshape(4, 3)).ravel() for view in views])

    found = least_squares(residuals, start.ravel(), loss="soft_l1", f_scale=_SOFT_PX, x_scale="jac")
    error_px = float(np.sqrt(2 * np.mean(residuals(found.x) ** 2)))
    limit_px = max(MAX_ERROR_PX, MAX_ERROR_SHARE * max(max(view.camera.width, view.camera.height) for view in views))
    if not error_px <= limit_px:
        problem = (
            f"no position of marker {marker_id} fits: its corners are off by {error_px:.1f} px, over {limit_px:.1f}"
        )
        fix = "Print every marker once, and leave out photographs from before it was moved."
        raise MapError(problem, value=" ".join(images), fix=fix)
    return Marker(marker_id, found.x.reshape(4, 3), images, error_px)


def _meeting_point(views: Sequence[MarkerView], corner: int) -> Float:
    """The point (3,) with the least sum of squared distances to the rays through a corner."""
    matrix = np.zeros((3, 3))
    vector = np.zeros(3)
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
    """OpenCV's detector of a dictionary's markers. Raises ConfigError if it has no such dictionary."""
    import cv2

    names = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
    if dictionary not in names:
        raise ConfigError("OpenCV has no such dictionary of markers", value=dictionary, fix=f"Use one of {names}.")
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    return cv2.aruco.ArucoDetector(markers, parameters)


def refine_corners(grey: NDArray[np.uint8], corners: Float) -> Float:
    """Move a marker's corners (4, 2) to where lines through its edges meet, or not if an edge cannot be made out.

    (0, 0) is the centre of the top-left pixel of the image (H, W) uint8; the corners are right to a pixel or two.
    OpenCV's refinement looks at a window around each corner. Blur rounds a corner off, so that it is found inside the
    square: in rendered images the sides come out 0.6 % short, which would become an error of the map's scale. Blur does
    not move an edge.
    """
    at = np.asarray(corners, dtype=np.float64)
    for _ in range(_ROUNDS):
        lines = [_edge_line(grey, at[side], at[(side + 1) % 4], at.mean(0)) for side in range(4)]
        if any(line is None for line in lines):
            return corners
        homogeneous = np.array([np.cross(lines[side - 1], lines[side]) for side in range(4)])  # type: ignore[arg-type]
        with np.errstate(divide="ignore", invalid="ignore"):
            moved = homogeneous[:, :2] / homogeneous[:, 2:]
        limit = 0.1 * np.linalg.norm(np.roll(at, -1, axis=0) - at, axis=1).min() + 1
        if not np.linalg.norm(moved - corners, axis=1).max() < limit:
            return corners
        at = moved
    return at


def _edge_line(grey: NDArray[np.uint8], start: Float, end: Float, inside: Float) -> Float | None:
    """The line (a, b, c), a x + b y + c = 0, of an edge between dark inside and bright outside; None if there is none.

    In a profile across the edge, the edge is at the mean position of the rise in brightness.
    """
    import cv2

    along = end - start
    length = float(np.linalg.norm(along))
    if length < 4:
        return None
    normal = np.array([-along[1], along[0]]) / length
    if normal @ (inside - start) > 0:
        normal = -normal
    half = float(np.clip(length / 16, 1.5, 6.0))  # within the black frame, a sixth to a tenth of the marker
    across = np.linspace(-half, half, 2 * round(half * _STEPS_PER_PX) + 1)
    share = np.linspace(_AWAY_FROM_CORNERS, 1 - _AWAY_FROM_CORNERS, _SAMPLES)
    middle = start + share[:, None] * along
    at = (middle[:, None] + across[:, None] * normal).astype(np.float32)
    profile = cv2.remap(grey.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
    rise = np.maximum(np.diff(profile, axis=1), 0)
    total = rise.sum(1)
    strong = total > max(10.0, 0.5 * float(np.median(total)))
    if strong.sum() < _SAMPLES // 2:
        return None
    offset = (rise[strong] @ ((across[1:] + across[:-1]) / 2)) / total[strong]
    typical = np.abs(offset - np.median(offset))
    near = typical <= max(0.5, 3 * float(np.median(typical)))
    points = middle[strong][near] + offset[near, None] * normal
    center = points.mean(0)
    across_points = np.linalg.svd(points - center)[2][1]
    return np.array([*across_points, -across_points @ center])
