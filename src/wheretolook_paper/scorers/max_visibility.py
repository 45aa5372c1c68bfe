"""The baseline of the Active Localization Benchmark (ActLoc, 2025), as released and fixed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from wheretolook.geometry.lattices import axes_of_angles, yaw_pitch_angles
from wheretolook.geometry.poses import Float, check_poses, poses_looking_along
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import rule

if TYPE_CHECKING:
    from wheretolook.inputs.localization_map import LocalizationMap

MAX_DEPTH_M = 3.0  # landmarks farther along the optical axis do not count, in place of occlusion

VIEWS_AT_ONCE = 512


class MaxVisibilityScorer(Scorer):
    """Landmarks in view within 3 m of depth, ignoring occlusion, as a share of the map's.

    The benchmark chooses the best of 6 x 18 pitches and yaws by this count, and its code then exchanges the two angles;
    see `SwappedMaxVisibilityScorer`. Here every candidate is ranked by its own count.
    """

    name = "max-visibility"

    def score(self, cam_from_world: Float) -> Float:
        """Return (B,) in [0, 1]."""
        # Warp takes seconds to load
        from wheretolook.visibility.frustum import LandmarkSets, PosedViews, landmarks_in_view

        poses = check_poses(cam_from_world)
        camera = self.localization_map.camera
        device = self.localization_map.device
        points = self.localization_map.landmarks.points
        everything = np.arange(len(points), dtype=np.int32)
        candidates = LandmarkSets(np.array([0, len(points)], dtype=np.int32), everything)
        counts = np.empty(len(poses))
        for begin in range(0, len(poses), VIEWS_AT_ONCE):
            block = poses[begin : begin + VIEWS_AT_ONCE]
            rows = np.zeros(len(block), dtype=np.int64)
            seen = landmarks_in_view(PosedViews(camera, block, points, candidates, rows), device)
            view = np.repeat(np.arange(len(block)), np.diff(seen.starts))
            depth = np.einsum("ni,ni->n", points[seen.indices], block[view, 2, :3]) + block[view, 2, 3]
            counts[begin : begin + len(block)] = np.bincount(view[depth < MAX_DEPTH_M], minlength=len(block))
        return counts / max(1, len(points))


class SwappedMaxVisibilityScorer(Scorer):
    """The released code: the best of 6 x 18 pitches and yaws, returned with the two angles exchanged.

    A view's score grows as its optical axis approaches the returned direction.
    """

    name = "max-visibility-swapped"

    def __init__(self, localization_map: LocalizationMap) -> None:
        super().__init__(localization_map)
        self._count = MaxVisibilityScorer(localization_map)

    def score(self, cam_from_world: Float) -> Float:
        """Return (B,) in [0, 1]: half of one plus the cosine between the two axes."""
        from wheretolook.inputs.localization_map import shared_locations

        poses = check_poses(cam_from_world)
        locations, rows = shared_locations(poses)
        angles = yaw_pitch_angles()
        axes = np.empty((len(locations), 3))
        for row, location in enumerate(locations):
            lattice = poses_looking_along(np.broadcast_to(location, (len(angles), 3)), axes_of_angles(angles))
            best = angles[np.argmax(self._count.score(lattice))]
            axes[row] = axes_of_angles(best[None, ::-1])[0]
        return np.asarray((1 + np.einsum("bi,bi->b", poses[:, 2, :3], axes[rows])) / 2)


METHODS = (rule(MaxVisibilityScorer), rule(SwappedMaxVisibilityScorer))
