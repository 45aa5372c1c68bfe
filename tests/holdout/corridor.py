"""A COLMAP model of a corridor, whose photographs, landmarks and descriptors are known; and its database."""

import numpy as np
import pycolmap

from wheretolook.features.extractor import SIFT
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.mapping.triangulation import fill_database

N = 30  # photographs, and the rows of those that look at what no other sees
ALONE = (27, 28, 29)
WIDTH = 320
HEIGHT = 240


def corridor_poses():
    """27 photographs half a metre apart look at a wall 2 m away; 3 more, at the end, look the other way."""
    along = np.column_stack([0.5 * np.arange(27), np.zeros(27), np.full(27, 1.5)])
    end = np.column_stack([6 + 0.5 * np.arange(3), np.zeros(3), np.full(3, 1.5)])
    axes = np.array([(0.0, 1.0, 0.0)] * 27 + [(0.0, -1.0, 0.0)] * 3)
    return poses_looking_along(np.concatenate([along, end]), axes)


def write_corridor(folder, noise_px=0.2, photographs=N, scale=1.0, rotation=np.eye(3), kind=SIFT):
    """Write the model and its database of keypoints and descriptors; their paths.

    Odd photographs are taken with a camera of another model. `scale` and `rotation` take the corridor to a frame of the
    model's own.
    """
    rng = np.random.default_rng(0)
    front = rng.uniform((-2, 2, 0.2), (15, 3, 2.8), (1500, 3))
    back = rng.uniform((4, -3, 0.2), (9, -2, 2.8), (400, 3))
    points = np.concatenate([front, back])
    words = rng.gamma(0.5, size=(len(points), kind.dimension))
    if not kind.in_bytes:
        words = rng.normal(size=words.shape)
    model = pycolmap.Reconstruction()
    for camera_id, (name, params) in enumerate(
        [("PINHOLE", [160.0, 160.0, 160.0, 120.0]), ("SIMPLE_RADIAL", [160.0, 160.0, 120.0, -0.02])], 1
    ):
        camera = pycolmap.Camera(camera_id=camera_id, model=name, width=WIDTH, height=HEIGHT, params=params)
        model.add_camera_with_trivial_rig(camera)
    stored = []
    seen_by = [list[tuple[int, int]]() for _ in points]
    for row, pose in enumerate(corridor_poses()[:photographs]):
        camera = model.cameras[1 + row % 2]
        in_camera = points @ pose[:, :3].T + pose[:, 3]
        ahead = np.flatnonzero(in_camera[:, 2] > 0.1)
        pixels = np.asarray(camera.img_from_cam(in_camera[ahead]))
        inside = ((pixels > 0) & (pixels < (WIDTH, HEIGHT))).all(1)
        rows = ahead[inside]
        pixels = pixels[inside] + rng.normal(0, noise_px, (int(inside.sum()), 2))
        noisy = words[rows] + rng.normal(0, 0.05, (len(rows), kind.dimension))
        noisy = np.maximum(noisy, 0) if kind.in_bytes else noisy
        stored.append((pixels.astype(np.float32), kind.store(noisy / np.linalg.norm(noisy, axis=1)[:, None])))
        image = pycolmap.Image(
            name=f"{row:03}.jpg", camera_id=camera.camera_id, image_id=row + 1, keypoints=stored[-1][0].astype(float)
        )
        moved = np.column_stack([pose[:, :3] @ rotation.T, scale * pose[:, 3]])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(moved))
        for keypoint, point in enumerate(rows):
            seen_by[point].append((row + 1, keypoint))
    for point, seen in enumerate(seen_by):
        if len(seen) > 1:
            track = pycolmap.Track()
            for image_id, keypoint in seen:
                track.add_element(image_id, keypoint)
            model.add_point3D(scale * points[point] @ rotation.T, track, np.zeros(3, dtype=np.uint8))
    model.update_point_3d_errors()
    sparse = folder / "sparse"
    database = folder / ("features.db" if kind is SIFT else f"{kind.name}.db")
    sparse.mkdir(parents=True)
    model.write_binary(str(sparse))
    fill_database(database, model, stored, kind)
    return sparse, database
