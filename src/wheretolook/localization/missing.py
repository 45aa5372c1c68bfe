"""Counts what a pose should have found and did not: the landmarks expected in parts of an image without any inlier.

Where rooms are copies of one another and not all are mapped, a wrong pose may explain every match. But copies differ
somewhere: there the map has landmarks of which none is found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.poses import Float, camera_centers, transform
from wheretolook.localization.confidence import LogisticRegression
from wheretolook.localization.rig import Look


@dataclass(frozen=True)
class DetectionModel(LogisticRegression):
    """Probability that a landmark in the image is an inlier of the right pose, without a network or a mesh."""

    # log of the observations; angle between the ray and the mean mapping direction, over 45 degrees, and its square;
    # |log of the distance over the mean mapping distance|; log of a pixel's size at the landmark over that at mapping;
    # square root of the spread of the mapping directions; log of the distance over that of the nearest fifth of the
    # landmarks in the same part of the image, which may hide it
    names = ("track_length", "angle", "squared_angle", "distance", "pixel_size", "direction_spread", "behind")
    about = "detection"
    file = Path(__file__).with_name("missing.json")


@dataclass(frozen=True, eq=False)
class ExpectedLandmarks:
    """The landmarks of a map, with what decides whether they are detected; at most 50,000, evenly drawn.

    Attributes:
        points: (N, 3) m.
        directions: (N, 3) unit mean directions from the mapping cameras.
        attributes: (N, 4) logs of the observations, of the mean mapping distance (m) and of this over the focal length
            of the mapping cameras (px), and the spread of the directions; NaN where unknown.
        each: landmarks of the map per landmark here.
    """

    points: Float
    directions: Float
    attributes: Float
    each: float

    @classmethod
    def of(cls, points: Float, directions: Float, attributes: Float, names: Sequence[str]) -> ExpectedLandmarks:
        """Draw from landmarks with `MAP_ATTRIBUTES` (N, A) of these names."""
        rows = np.unique(np.linspace(0, len(points) - 1, min(len(points), 50_000)).astype(np.int64))
        used = ("track_length", "mapped_distance", "mapped_pixel_size", "direction_spread")
        columns = [list(names).index(name) for name in used]
        described = np.asarray(attributes[rows][:, columns], dtype=np.float64)
        return cls(points[rows], directions[rows], described, len(points) / max(len(rows), 1))

    def in_image(self, look: Look, cam_from_world: Float) -> tuple[Float, Float]:
        """Return the pixels (M, 2) of the landmarks that project into a view, and their probabilities of detection (M,)."""
        camera = look.camera
        in_camera = transform(cam_from_world, self.points)
        rows = np.flatnonzero(in_camera[:, 2] > 0.01)
        pixels = camera.project(in_camera[rows])
        inside = camera.in_image(pixels)
        rows, pixels = rows[inside], pixels[inside]
        if len(rows) == 0:
            return pixels, np.zeros(0)
        offsets = self.points[rows] - camera_centers(cam_from_world)
        distance = np.linalg.norm(offsets, axis=1)
        cosine = (offsets * self.directions[rows]).sum(1) / distance
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1))) / 45
        observed, mapped, mapped_size, spread = self.attributes[rows].T
        log_distance = np.log(distance)
        size = np.clip(log_distance - np.log(camera.mean_focal_px) - mapped_size, -2, 2)
        change = np.minimum(np.abs(log_distance - mapped), 2)
        behind = np.minimum(log_distance - _nearest(cells_of(look, pixels, 24, 18), log_distance), 2).clip(0)
        values = [observed, angle, angle**2, change, size, np.sqrt(spread), behind]
        return pixels, DetectionModel.bundled().predict_proba(np.nan_to_num(np.stack(values, axis=1)))

    def missing(self, looks: Sequence[Look], cams_from_world: Float, inliers: Sequence[NDArray[np.bool_]]) -> float:
        """Return the share of the expected detections that fall into parts of the images without any inlier.

        Each image has 6 x 4 parts; those where less than one landmark is expected do not count.
        """
        total = missed = 0.0
        for look, pose, mask in zip(looks, cams_from_world, inliers, strict=True):
            pixels, p_detect = self.in_image(look, pose)
            expected = self.each * np.bincount(cells_of(look, pixels), p_detect, minlength=24)
            found = np.bincount(cells_of(look, look.pixels[mask]), minlength=24)
            counts = expected >= 1
            total += float(expected[counts].sum())
            missed += float(expected[counts & (found == 0)].sum())
        return missed / total if total else 0.0


def cells_of(look: Look, pixels: Float, across: int = 6, down: int = 4) -> NDArray[np.int64]:
    """Return the part (M,) of a view's image, of across x down, that each of its pixels (M, 2) is in."""
    size = (look.camera.width, look.camera.height)
    cell = np.clip(np.floor(pixels / size * (across, down)), 0, (across - 1, down - 1)).astype(np.int64)
    return np.asarray(cell[:, 0] * down + cell[:, 1])


def _nearest(cells: NDArray[np.int64], distance: Float) -> Float:
    """Return for each landmark (M,) the distance below which a fifth of those in its cell are."""
    order = np.lexsort((distance, cells))
    _, first, of_each, count = np.unique(cells[order], return_index=True, return_inverse=True, return_counts=True)
    result = np.empty(len(cells))
    result[order] = distance[order][first + count // 5][of_each]
    return result
