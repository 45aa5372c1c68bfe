"""COLMAP models of points that are seen at known poses."""

import numpy as np
import pycolmap

from wheretolook.geometry.poses import transform


def colmap_model(points, poses, seen, cameras, project=True, error_px=0.3):
    """Return a model of points (N, 3) in images at poses (B, 3, 4), by cameras in turn; `seen` (B, N) masks observations.

    Keypoints are projections, or all at one pixel. Points seen less than twice are left out.
    """
    model = pycolmap.Reconstruction()
    for number, camera in enumerate(cameras, 1):
        model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=number, **camera.colmap.record()))
    tracks = [pycolmap.Track() for _ in points]
    for index, (pose, mask) in enumerate(zip(poses, seen, strict=True)):
        number = index % len(cameras)
        rows = np.flatnonzero(mask)
        pixels = cameras[number].project(transform(pose, points[rows])) if project else np.full((len(rows), 2), 100.0)
        image = pycolmap.Image(name=f"{index:03d}.jpg", keypoints=pixels, camera_id=number + 1, image_id=index + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
        for keypoint, row in enumerate(rows.tolist()):
            tracks[row].add_element(index + 1, keypoint)
    for point, track in zip(points, tracks, strict=True):
        if track.length() >= 2:
            model.add_point3D(point, track, np.zeros(3, dtype=np.uint8))
    for landmark in model.points3D.values():
        landmark.error = error_px
    return model
