"""A small COLMAP model: landmarks on the walls of a room of 6 x 5 x 3 m, seen by twelve images."""

import json
from pathlib import Path

import numpy as np
import pycolmap

from wheretolook.geometry.poses import poses_looking_along

WEIGHTS = Path(__file__).parents[2] / "data" / "release" / "weights"
POINTS = np.array([(1.5, 2.0, 1.5), (2.0, 2.2, 1.4), (2.6, 2.4, 1.5), (3.2, 2.5, 1.6)])


def write_room(folder, text=False, n=400, metric=True):
    rng = np.random.default_rng(0)
    points = rng.uniform((0, 0, 0.2), (6, 5, 2.8), (n, 3))
    wall = rng.integers(0, 2, n)
    points[np.arange(n), wall] = np.where(rng.random(n) < 0.8, 0.0, np.array([6.0, 5.0])[wall])
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[320, 320, 320, 240], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    centers = rng.uniform((1.5, 1.5, 1), (4.5, 3.5, 2), (12, 3))
    axes = np.column_stack([np.cos(np.arange(12)), np.sin(np.arange(12)), np.zeros(12)])
    seen_by = np.argsort(rng.random((n, 12)), axis=1)[:, :4]
    of_image = [np.flatnonzero((seen_by == image).any(axis=1)).tolist() for image in range(12)]
    for number, (pose, seen) in enumerate(zip(poses_looking_along(centers, axes), of_image, strict=True)):
        image = pycolmap.Image(name=f"{number:03}.jpg", keypoints=np.full((len(seen), 2), 100.0), camera_id=1)
        image.image_id = number + 1
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for point, images in enumerate(seen_by):
        track = pycolmap.Track()
        for image in images:
            track.add_element(int(image) + 1, of_image[image].index(point))
        model.add_point3D(points[point], track, np.zeros(3, dtype=np.uint8))
    for point in model.points3D.values():
        point.error = 0.3
    folder.mkdir(parents=True)
    if metric:  # as the report of a rendered map states
        (folder / "report.json").write_text(json.dumps({"n_landmarks": n}))
    (model.write_text if text else model.write_binary)(str(folder))
    return folder
