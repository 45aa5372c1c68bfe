"""The baseline of the Active Localization Benchmark (ActLoc, 2025), as it ships and mended."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from wheretolook.geometry.lattices import axes_of_angles, yaw_pitch_angles
from wheretolook.geometry.poses import Float, check_poses, poses_looking_along, split_poses
from wheretolook.inputs.localization_map import SAME_LOCATION_DECIMALS, LocalizationMap
from wheretolook.methods.base import Scorer
from wheretolook.visibility.frustum import VisibleSets, visible_landmarks

MAX_DEPTH_M = 3.0
"""Landmarks farther along the optical axis do not count, in place of occlusion."""

VIEWS_AT_ONCE = 512


class MaxVisibilityScorer(Scorer):
    """Landmarks in view within 3 m of depth, seen through walls, as a share of the map's.

    The benchmark looks for the best of 6 x 18 pitches and yaws by this count. Its code then gives pitch and yaw to a
    function that takes yaw and pitch; see `SwappedMaxVisibilityScorer`. Here every candidate is ranked by its own
    count, on the lattice or off it, while the swapped one knows a single axis.
    """

    name: ClassVar[str] = "max-visibility"

    def score(self, cam_from_world: Float) -> Float:
        """(B,) in [0, 1]."""
        poses = check_poses(cam_from_world)
        one, points = self.localization_map, self.localization_map.landmarks.points
        everything = np.arange(len(points), dtype=np.int32)
        candidates = VisibleSets(np.array([0, len(points)], dtype=np.int32), everything)
        counts = np.empty(len(poses))
        for begin in range(0, len(poses), VIEWS_AT_ONCE):
            block = poses[begin : begin + VIEWS_AT_ONCE]
            rows = np.zeros(len(block), dtype=np.int64)
            seen = visible_landmarks(one.camera, block, points, candidates, rows, one.device)
            view = np.repeat(np.arange(len(block)), np.diff(seen.starts))
            depth = np.einsum("ni,ni->n", points[seen.indices], block[view, 2, :3]) + block[view, 2, 3]
            counts[begin : begin + len(block)] = np.bincount(view[depth < MAX_DEPTH_M], minlength=len(block))
        return counts / max(1, len(points))


class SwappedMaxVisibilityScorer(Scorer):
    """What the benchmark's code does: the best of 6 x 18 pitches and yaws, with the two exchanged in what it returns.

    Views by how near they look to what it returns.
    """

    name: ClassVar[str] = "max-visibility-swapped"

    def __init__(self, localization_map: LocalizationMap) -> None:
        super().__init__(localization_map)
        self._count = MaxVisibilityScorer(localization_map)

    def score(self, cam_from_world: Float) -> Float:
        """(B,) in [0, 1]: half of one plus the cosine between the two axes."""
        poses = check_poses(cam_from_world)
        centers = np.round(split_poses(poses)[1], SAME_LOCATION_DECIMALS)
        locations, rows = np.unique(centers, axis=0, return_inverse=True)
        angles = yaw_pitch_angles()
        axes = np.empty((len(locations), 3))
        for row, location in enumerate(locations):
            lattice = poses_looking_along(np.broadcast_to(location, (len(angles), 3)), axes_of_angles(angles))
            best = angles[np.argmax(self._count.score(lattice))]
            axes[row] = axes_of_angles(best[None, ::-1])[0]
        return np.asarray((1 + np.einsum("bi,bi->b", poses[:, 2, :3], axes[rows.reshape(-1)])) / 2)
