"""Space near the mapping cameras and landmarks: where a map without a mesh holds."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from wheretolook.geometry.poses import Float, as_points
from wheretolook.space.config import MappedSpaceConfig
from wheretolook.utils.errors import MapError


class MappedSpace:
    """Tests locations against a map's landmarks (N, 3) m and the places (M, 3) m where its images were taken.

    `bounds` (2, 3) m is the box around the cameras, enlarged by `max_camera_distance_m`, within the box around cameras
    and landmarks (without the outermost per cent along each axis). Raises MapError without landmarks or cameras.
    """

    def __init__(
        self, landmarks: ArrayLike, cameras: ArrayLike, config: MappedSpaceConfig = MappedSpaceConfig()
    ) -> None:
        self.config = config
        points = as_points(landmarks)
        centers = as_points(cameras)
        if not len(points) or not len(centers):
            value = (len(points), len(centers))
            fix = "Run the map stage again."
            raise MapError("the map has no landmarks or no cameras", value=value, fix=fix)
        self._landmarks = cKDTree(points)
        self._cameras = cKDTree(centers)
        reach = self.config.max_camera_distance_m
        lowest = centers.min(0)
        highest = centers.max(0)
        low, high = np.quantile(points, (0.01, 0.99), axis=0)
        lower = np.maximum(lowest - reach, np.minimum(low, lowest))
        upper = np.minimum(highest + reach, np.maximum(high, highest))
        self.bounds: Float = np.stack([lower, upper])

    def is_free(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether a camera can be at points (N, 3) metres; (N,)."""
        at = as_points(points)
        free = ((at >= self.bounds[0]) & (at <= self.bounds[1])).all(axis=1)
        free &= self._cameras.query(at)[0] <= self.config.max_camera_distance_m
        free &= self._landmarks.query(at)[0] >= self.config.clearance_m
        return free

    def segments_are_free(self, a: ArrayLike, b: ArrayLike) -> NDArray[np.bool_]:
        """Whether a camera can move straight from a (N, 3) to b (N, 3) metres; (N,).

        Both ends must be free, no landmark may be closer to the segment than the clearance, and the segment must stay
        near mapping cameras (tested every 2 cm).
        """
        start, end = np.broadcast_arrays(as_points(a), as_points(b))
        free = self.is_free(start) & self.is_free(end)
        for n in np.flatnonzero(free):
            free[n] = self._is_clear(start[n], end[n]) and self._stays_near_cameras(start[n], end[n])
        return free

    def _is_clear(self, start: Float, end: Float) -> bool:
        along = end - start
        length = float(np.linalg.norm(along))
        reach = length / 2 + self.config.clearance_m
        near = self._landmarks.data[self._landmarks.query_ball_point((start + end) / 2, reach)]
        share = np.clip((near - start) @ along / max(length**2, 1e-24), 0, 1)
        distance = np.linalg.norm(near - start - share[:, None] * along, axis=1)
        return bool((distance >= self.config.clearance_m).all())

    def _stays_near_cameras(self, start: Float, end: Float) -> bool:
        steps = max(2, int(np.ceil(np.linalg.norm(end - start) / 0.02)) + 1)
        points = start + np.linspace(0, 1, steps)[:, None] * (end - start)
        return bool((self._cameras.query(points)[0] <= self.config.max_camera_distance_m).all())
