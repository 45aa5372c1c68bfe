"""Labels sets of views that are localized jointly, from the stored matches of single views, without rendering.

Each view is rendered and matched once (`--label.store_pixels true`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.viewpoint_files import MATCH_FIELDS
from wheretolook.dataset.viewpoint_table import CAMERA_ID, PIXELS, poses
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float, pose_error
from wheretolook.localization.confidence import ConfidenceModel
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.estimation import PoseEstimator, SingleViewPoses
from wheretolook.localization.rig import Look, rig_of
from wheretolook.localization.rig_localization import JointLocalization, JointLocalizer
from wheretolook.utils.errors import TableError

SET_COLUMNS = (
    "n_looks",
    "location_id",
    "status",
    "error_m",
    "error_deg",
    "n_matches",
    "n_inliers",
    "support",
    "elsewhere",
    "own",
    "rival_own",
    "deviation_m",
    "deviation_deg",
    "confidence",
    "seconds",
)
"""Columns of `label_sets`. `status`, `error_m` and `error_deg` are as for single viewpoints, so `is_good` applies to sets,
too; `elsewhere` is the rival support, `own` and `rival_own` are the unique support of pose and rival."""


def label_sets(
    table: pd.DataFrame,
    sets: Sequence[Sequence[int] | NDArray[np.integer]],
    points: Float,
    cameras: Camera | Mapping[int, Camera],
    config: LocalizerConfig = LocalizerConfig(),
    turn_noise_deg: float = 0.0,
    seed: int = 0,
    progress: str | None = None,
    rigs: Sequence[Float] | None = None,
) -> pd.DataFrame:
    """Localize sets of a table's views jointly and measure the errors.

    A set has rows of the table with views of one location, whose relative rotations are those of the table, with
    `turn_noise_deg` of noise about each axis drawn from the seed; its error is that of the worst view. With `rigs`,
    cam_from_rig (N, 3, 4) in metres for each set, its views may be of several locations; its error is that of its
    first view. `points` (N, 3) m are the landmarks. A set of one view gets the label of a single image, up to the order
    of its matches. `progress` is the title of a progress bar. Returns a row per set, with `SET_COLUMNS`.

    Raises TableError if the table has no stored pixels or a row is invalid, PoseError if views of a set are not from
    one location, ConfigError for negative noise.
    """
    missing = [name for name in (*MATCH_FIELDS.names[:1], PIXELS) if name not in table]
    if missing:
        fix = "Label with `--label.store_pixels true`, and read the table with `pixels=True`."
        raise TableError("the table has no pixels of matches", value=missing, fix=fix)
    localizer = JointLocalizer(PoseEstimator(points, config), turn_noise_deg)
    rng = np.random.default_rng(seed)
    true_poses = poses(table)
    locations = table["location_id"].tolist()
    single_view: dict[int, SingleViewPoses] = {}
    known: dict[tuple[int, ...], tuple[object, ...]] = {}  # repeated sets, if nothing is drawn for each
    rows: list[tuple[object, ...]] = []
    for number, members in enumerate(tqdm(sets, desc=progress, unit="set", disable=progress is None)):
        key = tuple(map(int, members))
        if not key or max(key) >= len(table):
            raise TableError(f"a set of views has none or wrong rows of {len(table)}", value=key)
        if key not in known or turn_noise_deg or rigs is not None:
            true = true_poses[list(key)]
            rig = _noisy(rig_of(true), turn_noise_deg, rng) if rigs is None else rigs[number]
            looks = [_look(table, row, pose, cameras, len(points)) for row, pose in zip(key, rig, strict=True)]
            start = time.perf_counter()
            for row, look in zip(key, looks, strict=True):
                if row not in single_view:
                    single_view[row] = localizer.single_view_poses(look)
            result = localizer.localize(looks, [single_view[row] for row in key])
            seconds = time.perf_counter() - start
            label = set_label(result, true if rigs is None else true[:1])
            known[key] = (len(key), locations[key[0]], *label, seconds)
        rows.append(known[key])
    return pd.DataFrame(rows, columns=list(SET_COLUMNS))


def set_label(result: JointLocalization, true: Float) -> tuple[object, ...]:
    """Return `SET_COLUMNS` from status to confidence, given the true poses (N, 3, 4) of the first N views."""
    error_m = error_deg = np.nan
    if result.cams_from_world is not None:
        error_m, error_deg = (error.max() for error in pose_error(result.cams_from_world[: len(true)], true))
    return (
        result.status,
        error_m,
        error_deg,
        result.n_matches,
        result.n_inliers,
        result.support,
        result.rival_support,
        *result.unique_support,
        *result.deviation,
        ConfidenceModel.bundled().of(result),
    )


def _look(
    table: pd.DataFrame, row: int, cam_from_rig: Float, cameras: Camera | Mapping[int, Camera], n_points: int
) -> Look:
    if isinstance(cameras, Mapping):
        cameras = cameras[table[CAMERA_ID].to_numpy()[row]] if CAMERA_ID in table else next(iter(cameras.values()))
    landmarks = np.asarray(table["matched_rows"].iat[row], dtype=np.int64)
    pixels = np.asarray(table[PIXELS].iat[row], dtype=np.float64).reshape(-1, 2)
    if landmarks.max(initial=0) >= n_points:
        problem = f"a view matched a landmark that the map of {n_points} lacks"
        raise TableError(problem, value=int(landmarks.max()), fix="Label the scene again with its present map.")
    return Look(cam_from_rig, pixels, landmarks, cameras)


def _noisy(cam_from_rig: Float, turn_noise_deg: float, rng: np.random.Generator) -> Float:
    """Perturb the rotations of all views but the first, which defines the rig."""
    if turn_noise_deg == 0:
        return cam_from_rig
    from scipy.spatial.transform import Rotation

    noise = Rotation.from_rotvec(np.radians(rng.normal(0, turn_noise_deg, (len(cam_from_rig), 3)))).as_matrix()
    noise[0] = np.eye(3)
    return np.concatenate([noise @ cam_from_rig[:, :, :3], cam_from_rig[:, :, 3:]], axis=2)
