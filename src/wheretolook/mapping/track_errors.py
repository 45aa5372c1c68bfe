"""Estimate from the tracks of a map how much larger errors of poses are than independent keypoints make them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.pose_information import bearing_numbers, information_matrices
from wheretolook.geometry.poses import Float
from wheretolook.mapping.colmap_model import ModelArrays, observation_matrix, select_points

MIN_OBSERVED = 12  # landmarks that are left of those that an image observes


def log_error_ratio(images: ModelArrays, cameras: Mapping[int, Camera], noise_px: float) -> tuple[float, float] | None:
    """Estimate the log of the errors of poses on a map over their expected deviation, by its tracks alone.

    Blocks of a sixteenth and a quarter of the images, which share landmarks, are held out. The remaining landmarks are
    triangulated again, and images of the blocks localized by their keypoints, by Gauss-Newton steps from their poses in
    the whole map, with Cauchy weights. Expected deviations are those of independent keypoint noise (pixels) in all images.
    Returns the mean of the medians for positions and orientations, within the range of the maps that it was measured on,
    and its standard error over the images that blocks are around, NaN for one; None if keypoints or cameras are unknown,
    or too few images can be tested.
    """
    known = set(np.unique(images.image_cameras).tolist()) <= cameras.keys()
    n = len(images.image_ids)
    if images.observation_pixels is None or not known or n < 5 or not len(images.points):
        return None
    observes = observation_matrix(images)
    firsts = np.linspace(0, n - 1, min(6, n)).round().astype(int)
    shared = np.asarray((observes[firsts] @ observes.T).toarray())
    blocks = [
        (neighbours[: max(1, n // part)], neighbours[: 3 if n // part >= 3 else 1])
        for neighbours in np.argsort(-shared, axis=1, kind="stable")
        for part in (16, 4)
    ]
    # all landmarks of the tested images, whose common errors do not average out, and no others
    tested = np.unique(np.concatenate([rows for _, rows in blocks]))
    seen = np.asarray(observes[tested].sum(0)).reshape(-1) > 0
    tracks = _Tracks(select_points(images, seen), cameras, noise_px)
    of_block = [np.reshape(tracks.log_ratios(*block), (-1, 2)) for block in blocks]
    logs = np.concatenate(of_block)
    if len(logs) < 3:
        return None
    around = [np.concatenate(both) for both in zip(of_block[::2], of_block[1::2], strict=True)]
    means = [part.mean() for part in around if len(part)]
    error = np.std(means, ddof=1) / np.sqrt(len(means)) if len(means) > 1 else np.nan
    return float(np.clip(np.median(logs, axis=0).mean(), -0.5, 2.0)), float(error)


class _Tracks:
    """Rays of a map's observations (O), in the world, and their precisions in 1 / rad^2."""

    def __init__(self, images: ModelArrays, cameras: Mapping[int, Camera], noise_px: float) -> None:
        assert images.observation_pixels is not None
        self.points = images.points
        self.point = images.observation_point
        self.image = images.observation_image
        self.centers = images.image_centers
        self.rays = np.empty((len(self.image), 3))
        for row in range(len(images.image_ids)):
            of_image = self.image == row
            in_camera = cameras[int(images.image_cameras[row])].unproject(images.observation_pixels[of_image])
            self.rays[of_image] = in_camera @ images.image_poses[row, :, :3]
        self.known = np.isfinite(self.rays).all(1)  # some camera models have no ray of some pixels
        self.precision = (images.image_focal_px[self.image] / noise_px) ** 2

    def log_ratios(self, held_out: NDArray[np.integer], tested: NDArray[np.integer]) -> list[tuple[float, float]]:
        """Return log errors over deviations of position and orientation, for each tested image that can be localized."""
        rest = self.known & ~np.isin(self.image, held_out)
        points, covariances, known = self._triangulated(rest)
        found = []
        for image in tested:
            rows = np.flatnonzero((self.image == image) & self.known & known[self.point])
            if len(rows) >= MIN_OBSERVED:
                at = self.point[rows]
                found.append(self._localized(rows, points[at] - self.centers[image], covariances[at]))
        return [pair for pair in found if np.isfinite(pair).all()]

    def _triangulated(self, rest: NDArray[np.bool_]) -> tuple[Float, Float, NDArray[np.bool_]]:
        """Return points (P, 3), covariances (P, 3, 3), and which can be triangulated from some observations (O,)."""
        n = len(self.points)
        point = self.point[rest]
        offsets = self.points[point] - self.centers[self.image[rest]]
        distance = np.linalg.norm(offsets, axis=1)
        bearings = offsets / distance[:, None]
        across = np.eye(3) - bearings[:, :, None] * bearings[:, None]
        off = np.einsum("oij,oj->oi", across, self.rays[rest])
        spread = 1 - np.linalg.norm(_sums(bearings, point, n), axis=1) / np.maximum(np.bincount(point, minlength=n), 1)
        known = (np.bincount(point, minlength=n) >= 2) & (spread > np.radians(0.75) ** 2 / 2)  # rays 1.5 degrees apart
        step = np.zeros((n, 3))
        covariance = np.zeros((n, 3, 3))
        for _ in range(3):
            residual = off - np.einsum("oij,oj->oi", across, step[point]) / distance[:, None]
            weight = self.precision[rest] / (1 + (residual**2).sum(1) * self.precision[rest] / 4)
            normal = _sums((across * (weight / distance**2)[:, None, None]).reshape(-1, 9), point, n).reshape(-1, 3, 3)
            right = _sums(off * (weight / distance)[:, None], point, n)
            covariance[known] = np.linalg.inv(normal[known])
            step = np.einsum("pij,pj->pi", covariance, right)
        return self.points + step, covariance, known

    def _localized(self, rows: NDArray[np.integer], offsets: Float, covariances: Float) -> tuple[float, float]:
        """Return log errors over deviations of position and orientation of an image with observations `rows`.

        Its landmarks (M) are at offsets (M, 3) from the camera, and have covariances (M, 3, 3).
        """
        distance = np.linalg.norm(offsets, axis=1)
        bearings = offsets / distance[:, None]
        rays = self.rays[rows]
        off = rays - (rays * bearings).sum(1)[:, None] * bearings
        along = np.einsum("mi,mij,mj->m", bearings, covariances, bearings)
        variance = (np.trace(covariances, axis1=1, axis2=2) - along) / (2 * distance**2)
        precision = 1 / (1 / self.precision[rows] + variance)
        numbers = bearing_numbers(offsets)
        step = np.zeros(6)
        for _ in range(5):
            moved = step[:3] - (bearings @ step[:3])[:, None] * bearings
            residual = off + moved / distance[:, None] + np.cross(step[3:], bearings)
            weight = precision / (1 + (residual**2).sum(1) * precision / 4)
            information = information_matrices(weight @ numbers)
            right = np.concatenate([(off / distance[:, None]).T @ weight, np.cross(bearings, off).T @ weight])
            covariance = np.linalg.pinv(information)
            step = -covariance @ right
        variances = np.diag(covariance)
        position, orientation = (
            np.log(np.linalg.norm(step[part]) / np.sqrt(variances[part].sum())) for part in (slice(3), slice(3, 6))
        )
        return float(position), float(orientation)


def _sums(values: Float, groups: NDArray[np.integer], n: int) -> Float:
    """Sum values (O, K) over groups (O,), (n, K)."""
    return np.stack([np.bincount(groups, weights=column, minlength=n) for column in values.T], axis=1)
