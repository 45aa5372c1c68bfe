"""The table of viewpoints as a data frame: one row a viewpoint, joined by ids."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from wheretolook.dataset.config import (
    ALL,
    LOCALIZED as LOCALIZED,
    NO_POSE as NO_POSE,
    THRESHOLDS,
    TOO_FEW_MATCHES as TOO_FEW_MATCHES,
    Split,
    threshold_key,
)
from wheretolook.geometry.pose_files import POSE_COLUMNS, pose_values, poses_of_values
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.utils.errors import TableError

CAMERA_ID = "camera_id"  # optional column
PIXELS = "matched_pixels"  # optional column
APPEARANCE = "appearance"  # optional column
CHANGES = "changes"  # optional column

UNLABELLED = "unlabelled"

POSITIVE = tuple(f"positive_{threshold_key(threshold)}" for threshold in THRESHOLDS)
"""Columns of the shares of positives, from the finest threshold (the label) to the coarsest.

Positives at one threshold are positives at all coarser ones.
"""

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


def with_first_labels(table: pd.DataFrame) -> pd.DataFrame:
    """Replace columns of a table by those of the same name with the prefix `FIRST`."""
    return table.assign(**{str(name).removeprefix(FIRST): table[name] for name in table if str(name).startswith(FIRST)})


def pooled_labels(tables: Mapping[str, pd.DataFrame], splits: Mapping[str, Split]) -> pd.DataFrame:
    """Pool the labels of scenes, whose viewpoints and split are given by name; at least one, none empty.

    Columns: `scene`, `split`, `location_id`, `n_visible`, `status`, `error_m`, `error_deg`; `height_m`, the camera's
    height above its scene's lowest location; whether the view is within each threshold (`POSITIVE`) and, if all tables
    have labels by the first RANSAC result, the same by these, with the prefix `FIRST`. Raises TableError if some
    viewpoint has no label yet.
    """
    both = all(map(has_first, tables.values()))
    return pd.concat([_views(name, table, splits[name], both) for name, table in tables.items()], ignore_index=True)


def label_shares(views: pd.DataFrame) -> pd.DataFrame:
    """Return shares of labels, in [0, 1], of `pooled_labels`: a row for each scene, then for each split, then for all.

    `scene` and `split` are `ALL` in rows over several. Columns: `n_views`, `n_locations`; the share of viewpoints of each
    status and without any pose (`without_pose`); of positives at each threshold (`POSITIVE`);
    `locations_positive`, the share of locations with a positive at the finest; `finest_of_coarsest`, the share of the
    coarsest's positives that are positive at the finest; `same_label_share`, the share of viewpoints whose labels are
    all equal; `spearman`, the rank correlation of the finest and the coarsest label; median errors of the poses found
    for the coarsest's positives (`median_within_m`, `median_within_deg`) and for the others (`median_beyond_m`,
    `median_beyond_deg`). NaN where there is nothing to count. With labels by the first RANSAC result, also the shares
    of their positives, with the prefix `FIRST`.
    """
    by_scene = [(name, part["split"].iloc[0], part) for name, part in views.groupby("scene", sort=False)]
    by_split = [(ALL, split, part) for split, part in views.groupby("split", sort=False)]
    groups = [*by_scene, *by_split, (ALL, ALL, views)]
    return pd.DataFrame([{"scene": scene, "split": split, **_shares(part)} for scene, split, part in groups])


def _views(scene: str, table: pd.DataFrame, split: str, both: bool) -> pd.DataFrame:
    """The columns that the summary needs, with heights and the label at each threshold."""
    height = camera_centers(poses(table))[:, 2]
    height = np.round(height - height.min(), 6)  # so that all views of a location fall into one band
    labels = {}
    labelled = {"": table, FIRST: with_first_labels(table)} if both else {"": table}
    for prefix, by in labelled.items():
        for name, (error_m, error_deg) in zip(POSITIVE, THRESHOLDS, strict=True):
            labels[f"{prefix}{name}"] = is_good(by, error_m, error_deg)
    columns = table[["location_id", "n_visible", "status", "error_m", "error_deg"]]
    return columns.assign(scene=scene, split=split, height_m=height, **labels)


def _shares(views: pd.DataFrame) -> dict[str, Any]:
    finest, coarsest = (views[name].to_numpy() for name in (POSITIVE[0], POSITIVE[-1]))
    by_location = views.groupby(["scene", "location_id"])[POSITIVE[0]].any()
    positives = views[list(POSITIVE)].to_numpy()
    medians: dict[str, float] = {}
    for name, rows in (("within", coarsest), ("beyond", ~coarsest)):
        medians |= {f"median_{name}_{unit}": views.loc[rows, f"error_{unit}"].median() for unit in ("m", "deg")}
    return {
        "n_views": len(views),
        "n_locations": len(by_location),
        **{status: (views["status"] == status).mean() for status in (LOCALIZED, TOO_FEW_MATCHES, NO_POSE)},
        "without_pose": views["error_m"].isna().mean(),
        **{name: views[name].mean() for name in POSITIVE},
        "locations_positive": by_location.mean(),
        "finest_of_coarsest": (finest & coarsest).sum() / coarsest.sum() if coarsest.any() else np.nan,
        "same_label_share": (positives == positives[:, :1]).all(axis=1).mean(),
        "spearman": _correlation(finest, coarsest),
        **medians,
        **{str(name): views[name].mean() for name in views if str(name).startswith(FIRST)},
    }


def _correlation(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Correlation of two labels (B,). Of binary values, Spearman's and Pearson's are the same."""
    spread = a.std() * b.std()
    return float(((a & b).mean() - a.mean() * b.mean()) / spread) if spread > 0 else np.nan
