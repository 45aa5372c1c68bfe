"""Selected views: poses, scores and visible landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.camera_turns import pan_tilt_angles
from wheretolook.geometry.poses import Float, camera_centers, quaternion_from_rotation
from wheretolook.mapping.map_frame import IDENTITY, MapFrame
from wheretolook.select.formats import save_views


@dataclass(frozen=True, eq=False)
class SelectedViews:
    """V views: the best of each waypoint, in the order of waypoints, the best of a waypoint first.

    The world of poses is the map's own frame, in its unit; camera x right, y down, z forward. `cam_from_world` takes
    world to camera (world-to-camera); `quaternions_wxyz` and `quaternions_xyzw` are of the opposite, camera-to-world,
    as robots and TUM files have them.
    """

    waypoint: NDArray[np.int64]  # (V,) row of the waypoint in what was asked for, from 0
    waypoint_id: tuple[str, ...]  # V names of the waypoints
    rank: NDArray[np.int64]  # (V,) 1 for the best view of the waypoint
    cam_from_world: Float  # (V, 3, 4) float64
    score: Float  # (V,)
    expected_inliers: Float  # (V,) expected number of inliers; NaN where the method does not predict it
    n_visible: NDArray[np.int64]  # (V,) visible landmarks
    in_range: NDArray[np.bool_]  # (V,) whether the view is within the training distribution of the scorer
    camera: Camera  # of the views
    method: str  # name of the scorer
    set_score: Float | None = None  # (V,) probability that the waypoint's views localize jointly, if chosen so
    frame: MapFrame = IDENTITY  # the map's own frame: its unit and direction up, and how they are known
    # (V,) landmarks that are hard to match, see `wheretolook.inputs.reasons`: in the image, but occluded; and of the
    # visible ones those that are too far, seen too obliquely, or repeated (NaN for a map without descriptors)
    n_occluded: NDArray[np.int64] | None = None
    n_too_far: NDArray[np.int64] | None = None
    n_too_oblique: NDArray[np.int64] | None = None
    n_repeated: Float | None = None

    def __len__(self) -> int:
        return len(self.score)

    def __getitem__(self, rows: NDArray[np.int64]) -> SelectedViews:
        """Return some of the views."""
        values = {name: getattr(self, name)[rows] for name in _arrays(self)}
        return replace(self, waypoint_id=tuple(self.waypoint_id[row] for row in rows), **values)

    @property
    def positions(self) -> Float:
        """Camera centres in the map, (V, 3)."""
        return camera_centers(self.cam_from_world)

    @property
    def axes(self) -> Float:
        """Unit optical axes in the map, (V, 3)."""
        return np.asarray(self.cam_from_world[:, 2, :3])

    @property
    def _pan_tilt(self) -> tuple[Float, Float]:
        return pan_tilt_angles(self.axes @ self.frame.world_from_map.rotation.T)

    @property
    def yaw_deg(self) -> Float:
        """(V,) angle of the optical axis in the level plane: 0 along +x, 90 along +y; 0 straight up or down.

        In a map whose z is not up, x and y are those of the map after the smallest rotation that turns up to z.
        """
        return np.degrees(self._pan_tilt[0])

    @property
    def pitch_deg(self) -> Float:
        """(V,) angle of the optical axis above the level plane: 90 straight up."""
        return np.degrees(self._pan_tilt[1])

    @property
    def quaternions_wxyz(self) -> Float:
        """Unit quaternions wxyz (V, 4) of the orientation, camera-to-world, w >= 0."""
        return quaternion_from_rotation(np.swapaxes(self.cam_from_world[:, :, :3], 1, 2))

    @property
    def quaternions_xyzw(self) -> Float:
        """The same in the order xyzw."""
        return np.roll(self.quaternions_wxyz, -1, axis=1)

    def save(self, path: str | Path, format: str | None = None) -> None:
        """Write a file in the given format, or that of its name, see `wheretolook.select.formats`.

        Raises a ConfigError if there is no such format, or it holds one view of a waypoint and there are several.
        """
        save_views(self, Path(path), format)


def joined(parts: Sequence[SelectedViews]) -> SelectedViews:
    """Concatenate views of one camera and method."""
    values: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in _arrays(parts[0])
    }
    return replace(parts[0], waypoint_id=tuple(name for part in parts for name in part.waypoint_id), **values)


def _arrays(views: SelectedViews) -> list[str]:
    """Return the names of the fields that are arrays."""
    return [field.name for field in fields(views) if isinstance(getattr(views, field.name), np.ndarray)]
