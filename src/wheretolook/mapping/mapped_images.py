"""The images of a map with what they observe, and what is left of it without some of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float
from wheretolook.mapping.colmap_model import (
    ModelArrays,
    cameras_of_images,
    colmap_poses,
    model_arrays,
    read_model,
    select_points,
)

if TYPE_CHECKING:
    from wheretolook.mapping.landmarks import Landmarks


@dataclass(frozen=True, eq=False)
class MappedImages:
    """Images of a map, in the order of their ids in its model, and what they observe.

    Attributes:
        landmarks: of the map.
        arrays: its model in the world, in metres with z up; all points are landmarks.
        poses: (M, 3, 4) cam_from_world.
        cameras: (M,)
        offsets: of the log-odds of detection, once estimated, by network and occlusion.
    """

    landmarks: Landmarks
    arrays: ModelArrays
    poses: Float
    cameras: tuple[Camera, ...]
    offsets: dict[tuple[object, ...], float] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.cameras)

    @classmethod
    def of(cls, landmarks: Landmarks, arrays: ModelArrays, poses: Float, cameras: tuple[Camera, ...]) -> Self:
        """Return the images of a model, of which only the points that are landmarks count."""
        return cls(landmarks, select_points(arrays, np.isin(arrays.point_ids, landmarks.ids)), poses, cameras)

    def without(self, held_out: NDArray[np.int64]) -> Landmarks:
        """Return the landmarks with at least two observations in the other images, with the attributes of those tracks.

        `held_out` are rows of images. Coordinates, errors and ambiguities stay as they are.
        """
        arrays = self.arrays
        observations = ~np.isin(arrays.observation_image, held_out)
        point = np.repeat(np.arange(len(arrays.points)), np.diff(arrays.observation_start))
        counts = np.bincount(point[observations], minlength=len(arrays.points))
        left = replace(
            arrays,
            observation_start=np.concatenate([[0], np.cumsum(counts)]),
            observation_image=arrays.observation_image[observations],
            observation_keypoint=arrays.observation_keypoint[observations],
        )
        from wheretolook.mapping.landmarks import landmarks_of  # which imports this module

        return landmarks_of(self.landmarks, select_points(left, counts >= 2))


def read_images(model_dir: Path, landmarks: Landmarks) -> MappedImages:
    """Read the images of a map's COLMAP model, which is in metres with z up. Raises MapError as `read_model`."""
    model = read_model(model_dir)
    of_images = colmap_poses(model_dir, model), cameras_of_images(model_dir, model)
    return MappedImages.of(landmarks, model_arrays(model), *of_images)
