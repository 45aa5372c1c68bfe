"""A small COLMAP model: landmarks on the walls of a room of 6 x 5 x 3 m, seen by twelve images."""

import json
from pathlib import Path

import numpy as np

from colmap_models import colmap_model
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import poses_looking_along

WEIGHTS = Path(__file__).parents[2] / "data" / "release" / "weights"
POINTS = np.array([(1.5, 2.0, 1.5), (2.0, 2.2, 1.4), (2.6, 2.4, 1.5), (3.2, 2.5, 1.6)])


def write_room(folder, text=False, n=400, metric=True):
    rng = np.random.default_rng(0)
    points = rng.uniform((0, 0, 0.2), (6, 5, 2.8), (n, 3))
    wall = rng.integers(0, 2, n)
    points[np.arange(n), wall] = np.where(rng.random(n) < 0.8, 0.0, np.array([6.0, 5.0])[wall])
    centers = rng.uniform((1.5, 1.5, 1), (4.5, 3.5, 2), (12, 3))
    axes = np.column_stack([np.cos(np.arange(12)), np.sin(np.arange(12)), np.zeros(12)])
    seen = np.zeros((12, n), dtype=bool)
    seen[np.argsort(rng.random((n, 12)), axis=1)[:, :4].T, np.arange(n)] = True
    poses = poses_looking_along(centers, axes)
    model = colmap_model(points, poses, seen, (PinholeCamera(640, 480, 320.0),), project=False)
    folder.mkdir(parents=True)
    if metric:  # as the report of a rendered map states
        (folder / "report.json").write_text(json.dumps({"n_landmarks": n}))
    (model.write_text if text else model.write_binary)(str(folder))
    return folder
