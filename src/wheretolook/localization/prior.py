"""Matches of an image with the landmarks that a rough prior of its location allows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import Camera, field_of_view_deg
from wheretolook.geometry.poses import Float, as_numbers
from wheretolook.geometry.similarity import Similarity
from wheretolook.utils.errors import ConfigError, PoseError

if TYPE_CHECKING:
    from wheretolook.features.matches import Matches

MAX_DISTANCE_RATIO = 2.0  # distance over the mean mapping distance: farther landmarks are hardly detected
YAW_MARGIN_DEG = 30.0  # how far the yaw may be off


@dataclass(frozen=True, eq=False)
class PosePrior:
    """A rough location (3,) m in the world of the map, and the yaw of an image in degrees, if known."""

    location: Float
    yaw_deg: float | None = None

    @classmethod
    def of(cls, values: Sequence[float], world_from_map: Similarity) -> PosePrior:
        """Convert x, y, z and perhaps yaw in the map. Raises ConfigError unless they are finite numbers."""
        try:
            numbers = as_numbers(values)
        except PoseError:
            numbers = np.zeros(0)
        if numbers.shape not in ((3,), (4,)) or not np.isfinite(numbers).all():
            fix = "Give x,y,z in the map, and perhaps the yaw in degrees."
            raise ConfigError("this is no prior of the pose", value=values, fix=fix)
        return cls(world_from_map.apply(numbers[:3]), float(numbers[3]) if len(numbers) == 4 else None)

    def allows(self, points: Float, mapping_distance_m: Float, camera: Camera) -> NDArray[np.bool_]:
        """Return which landmarks, points (N, 3) m, the camera may detect from near the prior, whatever its pitch."""
        offset: Float = points - self.location
        allowed = np.linalg.norm(offset, axis=1) <= MAX_DISTANCE_RATIO * mapping_distance_m
        if self.yaw_deg is not None:
            angle = np.degrees(np.arctan2(offset[:, 1], offset[:, 0])) - self.yaw_deg
            limit = max(field_of_view_deg(camera)) / 2 + YAW_MARGIN_DEG
            allowed &= np.abs((angle + 180) % 360 - 180) <= limit
        return np.asarray(allowed)


def matches_among(matches: Matches, allowed: NDArray[np.bool_], max_ratio: float | None) -> Matches:
    """Match keypoints again with the allowed (N,) of their nearest landmarks.

    With a maximum ratio, the nearest allowed landmark is compared with the second nearest allowed one, or with the last
    of the nearest if there is none. A landmark keeps its nearest keypoint.
    """
    near = allowed[matches.near]
    keypoints = np.flatnonzero(near.any(axis=1))
    near = near[keypoints]
    squared = matches.squared[keypoints]
    rows = np.arange(len(keypoints))
    first = near.argmax(axis=1)
    near[rows, first] = False
    second = np.where(near.any(axis=1), near.argmax(axis=1), near.shape[1] - 1)
    distance = squared[rows, first]
    if max_ratio is not None:
        rows = np.flatnonzero(distance < max_ratio**2 * squared[rows, second])
    landmarks = matches.near[keypoints, first]
    rows = rows[np.argsort(distance[rows], kind="stable")]
    rows = np.sort(rows[np.unique(landmarks[rows], return_index=True)[1]])
    return matches._replace(keypoints=keypoints[rows], landmarks=landmarks[rows])
