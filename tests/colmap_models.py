"""COLMAP models of images and points that are given."""

import pycolmap


def colmap_model(cameras, images, points=(), error_px=-1.0):
    """Make a model whose images are numbered 1, 2, … and whose points 10, 20, ….

    Of `pycolmap.Camera`s, images (name, id of the camera, pose (3, 4), pixels (K, 2)), and points (position, track), a
    track with (row of the image, keypoint) of each observation.
    """
    model = pycolmap.Reconstruction()
    for camera in cameras:
        model.add_camera_with_trivial_rig(camera)
    for number, (name, camera_id, pose, pixels) in enumerate(images, 1):
        image = pycolmap.Image(name=name, camera_id=camera_id, image_id=number, keypoints=pixels)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for number, (xyz, seen) in enumerate(points, 1):
        track = pycolmap.Track()
        for image, keypoint in seen:
            track.add_element(int(image) + 1, int(keypoint))
        model.add_point3D_with_id(10 * number, pycolmap.Point3D(xyz=xyz, track=track, error=error_px))
    return model


def camera(camera_id, model, width, height, *params):
    """Make a `pycolmap.Camera`."""
    return pycolmap.Camera(camera_id=camera_id, model=model, width=width, height=height, params=params)
