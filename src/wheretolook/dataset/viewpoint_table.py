"""The table of viewpoints as a data frame: one row a viewpoint, joined by ids."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.dataset.config import LOCALIZED as LOCALIZED
from wheretolook.dataset.config import NO_POSE as NO_POSE
from wheretolook.dataset.config import TOO_FEW_MATCHES as TOO_FEW_MATCHES
from wheretolook.geometry.poses import Float
from wheretolook.io.poses import POSE_COLUMNS, pose_values, poses_of_values
from wheretolook.utils.errors import TableError

CAMERA_ID = "camera_id"  # optional column
PIXELS = "matched_pixels"  # optional column
APPEARANCE = "appearance"  # optional column
CHANGES = "changes"  # optional column

UNLABELLED = "unlabelled"

LABELS = ("status", "error_m", "error_deg", "n_inliers")
"""Columns that labelling fills in."""

FIRST = "first_"
"""Prefix of optional columns with the labels by the first RANSAC result, where the others are by several hypotheses."""


def poses(table: pd.DataFrame) -> Float:
    """cam_from_world poses (B, 3, 4) of a table's rows."""
    return poses_of_values(table[[*POSE_COLUMNS]])


def pose_columns(cam_from_world: Float) -> dict[str, Float]:
    """Pose columns, by name, of poses (B, 3, 4)."""
    return dict(zip(POSE_COLUMNS, pose_values(cam_from_world).T, strict=True))


def is_good(table: pd.DataFrame, max_error_m: float = 0.05, max_error_deg: float = 0.4) -> np.ndarray:
    """Labels (B,): True if localized with both errors below their limits. Raises TableError if one has no label yet."""
    unlabelled = int((table["status"] == UNLABELLED).sum())
    if unlabelled:
        raise TableError("viewpoints without labels", value=unlabelled, fix="Run the label stage (it resumes).")
    good = (table["status"] == LOCALIZED) & (table["error_m"] < max_error_m) & (table["error_deg"] < max_error_deg)
    return good.to_numpy()


def has_first(table: pd.DataFrame) -> bool:
    """Whether a table also has the labels by the first RANSAC result."""
    return f"{FIRST}{LABELS[0]}" in table


def by_first(table: pd.DataFrame) -> pd.DataFrame:
    """Replace columns of a table by those of the same name with the prefix `FIRST`."""
    return table.assign(**{str(name).removeprefix(FIRST): table[name] for name in table if str(name).startswith(FIRST)})


def shares_good(table: pd.DataFrame) -> tuple[NDArray[np.int64], Float]:
    """Ids (L,) of a table's locations, ascending, and the share of each one's viewpoints that localize, (L,)."""
    ids, rows = np.unique(table["location_id"].to_numpy(np.int64), return_inverse=True)
    return ids, np.bincount(rows, weights=is_good(table)) / np.bincount(rows)


def instructive_location(table: pd.DataFrame) -> int:
    """The first location whose share of viewpoints that localize is nearest to 0.5: where to look matters there."""
    ids, shares = shares_good(table)
    return int(ids[np.argmin(np.abs(shares - 0.5))])


def outcome_in_words(label: pd.Series, brief: bool = False) -> str:
    """The result of localizing a row of a table, in words; `brief` gives only the pose's error, if one was found.

    Empty if it was not tried.
    """
    status = str(label["status"])
    if status == UNLABELLED:
        return ""
    if status != LOCALIZED:
        return status.replace("_", " ")
    error_m = float(label["error_m"])  # a row may hold it in single precision
    right = error_m < 1
    error = f"{100 * error_m:.1f} cm, " if right else f"{error_m:.1f} m, "
    error += f"{label['error_deg']:.2f}° off" if right else f"{label['error_deg']:.0f}° off"
    return error if brief else f"{'pose' if right else 'wrong pose'} found, {error}"
