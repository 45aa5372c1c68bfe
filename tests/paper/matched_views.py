"""Views whose matches with landmarks are known, as the label stage stores them."""

import numpy as np
import pandas as pd

from wheretolook.dataset.viewpoint_table import pose_columns
from wheretolook.geometry.poses import pose_error, transform
from wheretolook.localization.estimation import PoseEstimator


def matched_views(points, camera, cam_from_world, wrong, seed=0):
    """Return the labels of views (B, 3, 4) of up to 40 points each, a share `wrong` (B,) of which is matched wrongly."""
    rng = np.random.default_rng(seed)
    estimator = PoseEstimator(points)
    labels = []
    for pose, share in zip(cam_from_world, wrong, strict=True):
        in_camera = transform(pose, points)
        projected = camera.project(in_camera)
        rows = np.flatnonzero((in_camera[:, 2] > 0.1) & camera.in_image(projected))
        rows = np.sort(rng.choice(rows, min(40, len(rows)), replace=False)).astype(np.int32)
        pixels = projected[rows] + rng.normal(0, 0.3, (len(rows), 2))
        at_random = rng.random(len(rows)) < share
        pixels[at_random] = rng.uniform((0, 0), (camera.width, camera.height), (int(at_random.sum()), 2))
        pixels = pixels.astype(np.float32)
        found = estimator.estimate(pixels, rows, camera) if len(rows) >= 4 else None
        inliers = rows[:0] if found is None else rows[found[1]]
        failed = "too_few_matches" if len(rows) < 4 else "no_pose"
        error = (np.nan, np.nan) if found is None else pose_error(found[0], pose)
        status = "localized" if len(inliers) >= 10 else failed
        labels.append((rows, inliers, pixels.ravel(), status, *error, len(inliers)))
    names = ["matched_rows", "inlier_rows", "matched_pixels", "status", "error_m", "error_deg", "n_inliers"]
    types = {"n_inliers": np.int32, "error_m": np.float32, "error_deg": np.float32}
    return pd.DataFrame(labels, columns=names).astype(types).assign(**pose_columns(cam_from_world))
