"""Open a COLMAP model for localization: landmarks, query camera and mapping poses."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float
from wheretolook.mapping.colmap_model import camera_of_model, colmap_poses, compact_poses, read_model
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks
from wheretolook.mapping.sanity import warn_of_frame


class ColmapSource(NamedTuple):
    """Parts of a COLMAP model in metres with z up."""

    landmarks: Landmarks
    camera: Camera  # the query camera
    mapping_poses: Float  # cam_from_world (M, 3, 4) of its images


def open_colmap(
    model: str | Path,
    camera: Camera | int | None = None,
    database: str | Path | None = None,
    max_reprojection_error_px: float | None = None,
    device: str = "cpu",
) -> ColmapSource:
    """Read a COLMAP model; arguments, errors and warnings are those of `LocalizationMap.from_colmap`.

    Without a database torch and Warp are not imported: importing them takes longer than reading 200,000 landmarks.
    """
    reconstruction = read_model(model)
    landmarks = load_colmap_landmarks(Path(model), database, max_reprojection_error_px, device, reconstruction)
    poses = colmap_poses(model, reconstruction)
    warn_of_frame(model, landmarks.mapping_distance_m, poses)
    if camera is None or isinstance(camera, int):
        camera = camera_of_model(reconstruction, Path(model), camera)
    return ColmapSource(landmarks, camera, compact_poses(poses))
