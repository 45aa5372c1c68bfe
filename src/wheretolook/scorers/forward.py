"""Prefers views along the robot's heading."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from wheretolook.geometry.poses import Float, camera_centers, check_poses
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.random import uniform
from wheretolook.scorers.registry import rule

if TYPE_CHECKING:
    from wheretolook.inputs.localization_map import LocalizationMap


class ForwardScorer(Scorer):
    """Views by their angle to a heading: the classical camera without a map (paper, Sec. 4.3).

    The heading, in the world, is a direction (3,) of any length but zero; or the direction of the nearest leg of a path
    of waypoints (W, 3) in metres, W > 1. None draws a horizontal heading for each location from the seed.

    Raises a ValueError if a heading is zero or not finite, or two consecutive waypoints are equal.
    """

    name = "forward"

    def __init__(self, localization_map: LocalizationMap, heading: ArrayLike | None = None, seed: int = 0) -> None:
        super().__init__(localization_map)
        self.seed = seed
        given = np.empty((0, 3)) if heading is None else np.asarray(heading, dtype=np.float64)
        path = np.stack([np.zeros(3), given]) if given.shape == (3,) else given
        self._starts = path[:-1]
        self._legs = np.diff(path, axis=0)
        lengths = np.linalg.norm(self._legs, axis=-1)
        if path.shape[1:] != (3,) or len(path) == 1 or not ((lengths > 0) & (lengths < np.inf)).all():
            raise ValueError(f"a heading is a direction (3,) of finite length, or a path (W, 3) of such: {given}")

    def headings(self, centers: ArrayLike) -> Float:
        """Return the headings (B, 3), of unit length, at camera centres (B, 3)."""
        at = np.asarray(centers, dtype=np.float64)
        if len(self._legs) == 0:
            angle = 2 * np.pi * uniform(at, self.seed)
            return np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
        along = np.einsum("bwi,wi->bw", at[:, None] - self._starts, self._legs) / (self._legs**2).sum(-1)
        nearest = self._starts + np.clip(along, 0, 1)[..., None] * self._legs
        leg = np.argmin(np.linalg.norm(at[:, None] - nearest, axis=-1), axis=1)
        return np.asarray((self._legs / np.linalg.norm(self._legs, axis=-1, keepdims=True))[leg])

    def score(self, cam_from_world: Float) -> Float:
        """Return (1 + cosine between optical axis and heading) / 2, (B,), of poses (B, 3, 4)."""
        poses = check_poses(cam_from_world)
        cosines = np.einsum("bi,bi->b", poses[:, 2, :3], self.headings(camera_centers(poses)))
        return np.asarray((1 + np.clip(cosines, -1, 1)) / 2)


METHODS = (
    rule(
        ForwardScorer,
        build=lambda map, options: ForwardScorer(
            map, options.heading[0] if len(options.heading) == 1 else options.heading or None, options.seed
        ),
    ),
)
