"""A tiny dataset for tests: random landmarks, views in all directions, and labels that follow a known rule."""

import numpy as np
import pandas as pd

from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.viewpoint_files import write_table
from wheretolook.dataset.viewpoint_table import LOCALIZED, NO_POSE, TOO_FEW_MATCHES, pose_columns
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.bins import bin_views_plain
from wheretolook.mapping.colmap_model import save_mapping_poses
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.visibility.frustum import LandmarkSets, PosedViews
from wheretolook.visibility.occlusion import StoredOcclusion

CAMERA = PinholeCamera(160, 120, 80.0)
BINS = 30


def make_landmarks(rng, n, **given):
    """Landmarks on one half of a box's walls, so that some directions see many and others none.

    Given attributes, a number for all or (n, …), replace random ones.
    """
    points = rng.uniform((-3, -3, 0), (3, 3, 2.5), (n, 3))
    wall = rng.integers(0, 2, n)
    points[np.arange(n), wall] = rng.choice([3.0, 2.9], n)
    values = {
        "track_length": rng.integers(2, 9, n).astype(np.int32),
        "reprojection_error_px": rng.random(n) / 2,
        "triangulation_angle_deg": rng.uniform(2, 40, n),
        "mapping_direction": points / np.linalg.norm(points, axis=1, keepdims=True),
        "mapping_direction_spread": rng.random(n),
        "mapping_distance_m": rng.uniform(1, 4, n),
        "ambiguity": rng.random(n),
        "mapping_distance_spread": np.linspace(0, 0.5, n),
        "mapping_focal_px": np.linspace(60, 120, n),
    }
    values |= {name: np.broadcast_to(given[name], value.shape) for name, value in values.items() if name in given}
    columns = {name: value.astype(np.int32 if name == "track_length" else np.float32) for name, value in values.items()}
    points = given.get("points", points)
    return Landmarks(ids=np.arange(n), points=points, descriptors=given.get("descriptors"), **columns)


def make_mapping_poses(seed, n=12):
    """Poses of mapping cameras that look around in the box."""
    rng = np.random.default_rng([seed, 1])
    return poses_looking_along(rng.uniform((-2, -2, 1), (2, 2, 2), (n, 3)), rng.normal(size=(n, 3)) * (1, 1, 0.2))


def make_scene(folder, split, seed, n_locations=24, n_directions=20, n_landmarks=500):
    """Write one labelled scene. The errors fall with the number of filled bins, the median view just localizes."""
    rng = np.random.default_rng(seed)
    scene = SceneFolder(folder, split, CAMERA)
    scene.map.mkdir(parents=True)
    landmarks = make_landmarks(rng, n_landmarks)
    landmarks.save(scene.landmarks)
    save_mapping_poses(make_mapping_poses(seed), scene.mapping_cameras)
    locations = rng.uniform((-2, -2, 0.5), (2, 2, 2), (n_locations, 3))
    mask = rng.random((n_locations, n_landmarks)) < 0.8
    StoredOcclusion.from_mask(locations, mask).save(scene.occlusion)

    location_id = np.repeat(np.arange(n_locations), n_directions)
    direction_id = np.tile(np.arange(n_directions), n_locations)
    cam_from_world = poses_looking_along(locations[location_id], fibonacci_sphere(n_directions)[direction_id])
    binned = bin_views_plain(
        PosedViews(CAMERA, cam_from_world, landmarks.points, LandmarkSets.from_mask(mask), location_id), BINS
    )
    filled = binned.n_filled
    error_m = 0.05 * (np.median(filled) / np.maximum(filled, 1)) ** 4 * 0.999
    status = np.where(filled == 0, TOO_FEW_MATCHES, np.where(error_m > 20, NO_POSE, LOCALIZED))
    error_m = np.where(status == LOCALIZED, error_m, np.nan)
    table = pd.DataFrame(
        {
            "viewpoint_id": 1000 + np.arange(len(location_id)),
            "location_id": location_id,
            "direction_id": direction_id,
            **pose_columns(cam_from_world),
            "n_visible": binned.n_visible,
            "visibility_rank": 0,
            "status": status,
            "error_m": error_m,
            "error_deg": error_m * 4,
            "n_inliers": np.where(status == LOCALIZED, filled, 0),
        }
    )
    write_table(table, scene.table)
    return scene


def make_dataset(root, splits=("train", "train", "test"), **options):
    """Write a dataset with one scene for each split named."""
    scenes = [make_scene(root / f"scene-{index}", split, seed=index, **options) for index, split in enumerate(splits)]
    dataset = Dataset(root, tuple(scenes))
    dataset.save()
    return dataset
