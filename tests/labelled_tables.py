"""Two small tables of labelled viewpoints, whose statistics are computed by hand."""

import numpy as np
import pandas as pd

from wheretolook.dataset.viewpoint_table import LOCALIZED, NO_POSE, TOO_FEW_MATCHES, pose_columns
from wheretolook.geometry.poses import poses_looking_along

NAN = float("nan")


def table(rows):
    """Viewpoints of rows (location, its height, landmarks in view, status, errors in metres and degrees)."""
    names = ["location_id", "z", "n_visible", "status", "error_m", "error_deg"]
    frame = pd.DataFrame(rows, columns=names)
    centers = np.column_stack([np.full((len(rows), 2), 7.0), frame.pop("z")])
    directions = np.random.default_rng(0).normal(size=(len(rows), 3))  # heights must not depend on the orientation
    return frame.assign(**pose_columns(poses_looking_along(centers, directions)))


HALL = table(
    [
        (0, -2.0, 5000, LOCALIZED, 0.004, 0.1),  # positive everywhere
        (0, -2.0, 400, LOCALIZED, 0.004, 0.4),  # the finest limit is exclusive
        (1, -2.0, 99, LOCALIZED, 0.4, 4.0),
        (2, -1.3, 100, LOCALIZED, 4.0, 9.0),
        (2, -1.3, 9, LOCALIZED, 4.0, 90.0),
        (2, -1.3, 5, NO_POSE, 0.004, 0.1),  # too few inliers: never positive
        (3, 1.1, 0, TOO_FEW_MATCHES, NAN, NAN),
        (3, 1.1, 2, NO_POSE, NAN, NAN),
    ]
)
SHED = table([(0, 10.0, 1000, LOCALIZED, 0.002, 0.2), (0, 10.0, 50, NO_POSE, 500.0, 179.0)])
SPLITS = {"hall": "train", "shed": "test"}
