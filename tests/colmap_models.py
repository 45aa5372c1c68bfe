"""COLMAP models of images and points that are given."""

import numpy as np
import pycolmap

from wheretolook.geometry.poses import transform


def camera(camera_id, model, width, height, *params):
    """Return a `pycolmap.Camera`."""
    return pycolmap.Camera(camera_id=camera_id, model=model, width=width, height=height, params=params)


def model_of(cameras, images, tracks=(), error_px=-1.0, id_step=1):
    """Return a model of `pycolmap.Camera`s, images and tracks, whose images are numbered 1, 2, …

    Images are (name, id of the camera, pose (3, 4), pixels (K, 2)); tracks are (position, [(row of the image, keypoint),
    …]); ids of points are multiples of `id_step`.
    """
    model = pycolmap.Reconstruction()
    for one in cameras:
        model.add_camera_with_trivial_rig(one)
    for number, (name, camera_id, pose, pixels) in enumerate(images, 1):
        image = pycolmap.Image(name=name, camera_id=camera_id, image_id=number, keypoints=pixels)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for number, (xyz, seen) in enumerate(tracks, 1):
        track = pycolmap.Track()
        for image, keypoint in seen:
            track.add_element(int(image) + 1, int(keypoint))
        model.add_point3D_with_id(id_step * number, pycolmap.Point3D(xyz=xyz, track=track, error=error_px))
    return model


def colmap_model(points, poses, seen, cameras, project=True, error_px=0.3):
    """Return a model of points (N, 3) in images at poses (B, 3, 4), by cameras in turn; `seen` (B, N) masks observations.

    Keypoints are projections, or all at one pixel. Points seen less than twice are left out.
    """
    images = []
    tracks = [[] for _ in points]
    for index, (pose, mask) in enumerate(zip(poses, seen, strict=True)):
        number = index % len(cameras)
        rows = np.flatnonzero(mask)
        pixels = cameras[number].project(transform(pose, points[rows])) if project else np.full((len(rows), 2), 100.0)
        images.append((f"{index:03d}.jpg", number + 1, pose, pixels))
        for keypoint, row in enumerate(rows):
            tracks[row].append((index, keypoint))
    of_colmap = [pycolmap.Camera(camera_id=number, **one.colmap.record()) for number, one in enumerate(cameras, 1)]
    observed = [(point, track) for point, track in zip(points, tracks, strict=True) if len(track) > 1]
    return model_of(of_colmap, images, observed, error_px)
