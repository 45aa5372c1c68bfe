"""Opens a map: its landmarks, and its images with what they observe."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float
from wheretolook.mapping.colmap_model import (
    ModelArrays,
    camera_of_model,
    cameras_of_images,
    colmap_poses,
    compact_poses,
    model_arrays,
    read_model,
    select_points,
)
from wheretolook.mapping.config import FrameOptions
from wheretolook.mapping.landmarks import Landmarks, landmarks_of, load_colmap_landmarks
from wheretolook.mapping.map_frame import MapFrame, find_frame
from wheretolook.mapping.sources import choose_features


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
        return landmarks_of(self.landmarks, select_points(left, counts >= 2))


def read_images(model_dir: Path, landmarks: Landmarks) -> MappedImages:
    """Read the images of a map's COLMAP model, which is in metres with z up. Raises MapError as `read_model`."""
    model = read_model(model_dir)
    of_images = colmap_poses(model_dir, model), cameras_of_images(model_dir, model)
    return MappedImages.of(landmarks, model_arrays(model), *of_images)


class ColmapSource(NamedTuple):
    """Parts of a COLMAP model in the world: metres, z up."""

    landmarks: Landmarks
    camera: Camera  # the query camera
    mapping_poses: Float  # cam_from_world (M, 3, 4) of its images
    frame: MapFrame  # of the model
    images: MappedImages  # the same images, with their cameras and observations


def open_colmap(
    model: str | Path,
    camera: Camera | int | None = None,
    database: str | Path | None = None,
    max_reprojection_error_px: float | None = None,
    device: str = "cpu",
    frame: FrameOptions = FrameOptions(),
    depth_scale: float | None = None,
) -> ColmapSource:
    """Read a COLMAP model; arguments, errors and warnings are those of `LocalizationMap.from_colmap`.

    `depth_scale` is that of `find_frame`. Without a database torch and Warp are not imported: importing them takes
    longer than reading 200,000 landmarks.
    """
    model = Path(model)
    reconstruction = read_model(model)
    database = choose_features(model, reconstruction, None if database is None else Path(database))
    arrays = model_arrays(reconstruction)
    found = find_frame(model, reconstruction, frame, depth_scale, arrays)
    arrays = found.of_arrays(arrays)
    landmarks = load_colmap_landmarks(model, database, max_reprojection_error_px, device, reconstruction, arrays=arrays)
    poses = found.world_from_map.apply_to_poses(colmap_poses(model, reconstruction))
    found.warn(model, landmarks.mapping_distance_m, poses)
    if camera is None or isinstance(camera, int):
        camera = camera_of_model(reconstruction, model, camera)
    images = MappedImages.of(landmarks, arrays, poses, cameras_of_images(model, reconstruction))
    return ColmapSource(landmarks, camera, compact_poses(poses), found, images)
