"""A COLMAP model of a corridor, whose photographs, landmarks and descriptors are known; and its database."""

import numpy as np

from colmap_models import camera, model_of
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
    cameras = [
        camera(1, "PINHOLE", WIDTH, HEIGHT, 160, 160, 160, 120),
        camera(2, "SIMPLE_RADIAL", WIDTH, HEIGHT, 160, 160, 120, -0.02),
    ]
    images = []
    stored = []
    tracks = [[] for _ in points]
    for row, pose in enumerate(corridor_poses()[:photographs]):
        taken_with = cameras[row % 2]
        in_camera = points @ pose[:, :3].T + pose[:, 3]
        ahead = np.flatnonzero(in_camera[:, 2] > 0.1)
        pixels = np.asarray(taken_with.img_from_cam(in_camera[ahead]))
        inside = ((pixels > 0) & (pixels < (WIDTH, HEIGHT))).all(1)
        rows = ahead[inside]
        pixels = (pixels[inside] + rng.normal(0, noise_px, (int(inside.sum()), 2))).astype(np.float32)
        noisy = words[rows] + rng.normal(0, 0.05, (len(rows), kind.dimension))
        noisy = np.maximum(noisy, 0) if kind.in_bytes else noisy
        stored.append((pixels, kind.store(noisy / np.linalg.norm(noisy, axis=1)[:, None])))
        moved = np.column_stack([pose[:, :3] @ rotation.T, scale * pose[:, 3]])
        images.append((f"{row:03}.jpg", taken_with.camera_id, moved, pixels.astype(float)))
        for keypoint, point in enumerate(rows):
            tracks[point].append((row, keypoint))
    moved = scale * points @ rotation.T
    seen = [(xyz, track) for xyz, track in zip(moved, tracks, strict=True) if len(track) > 1]
    model = model_of(cameras, images, seen)
    model.update_point_3d_errors()
    sparse = folder / "sparse"
    database = folder / ("features.db" if kind is SIFT else f"{kind.name}.db")
    sparse.mkdir(parents=True)
    model.write_binary(str(sparse))
    fill_database(database, model, stored, kind)
    return sparse, database
