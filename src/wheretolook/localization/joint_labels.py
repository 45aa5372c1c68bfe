"""Labels of sets of looks: whether they localize together. They cost no rendering beyond that of single views.

Each view is rendered and matched once (`--label.store_pixels true`); sets of views of a location are joined from that.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.viewpoint_table import CAMERA_ID, MATCH_FIELDS, PIXELS, poses
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float, pose_error
from wheretolook.localization.confidence import Confidence
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.estimation import PoseEstimator
from wheretolook.localization.rig import Look, rig_of
from wheretolook.localization.rig_localization import Alone, JointLocalizer
from wheretolook.utils.errors import TableError

SET_COLUMNS = (
    "n_looks", "location_id", "status", "error_m", "error_deg", "n_matches", "n_inliers", "support", "elsewhere", "own",
    "rival_own", "deviation_m", "deviation_deg", "confidence", "seconds",
)  # fmt: skip
"""What `label_sets` tells of each set; `status`, `error_m` and `error_deg` as of single viewpoints, so that
`viewpoints.table.is_good` serves sets, too."""


def label_sets(
    table: pd.DataFrame,
    sets: Sequence[Sequence[int] | NDArray[np.integer]],
    points: Float,
    cameras: Camera | Mapping[int, Camera],
    config: LocalizerConfig | None = None,
    turn_noise_deg: float = 0.0,
    seed: int = 0,
    confidence: Confidence | None = None,
    progress: str | None = None,
    rigs: Sequence[Float] | None = None,
) -> pd.DataFrame:
    """Localize sets of a table's views together, and measure the errors. Each set has rows of the table, of one place.
    Or of several, if `rigs` tell for each set where its views are to one another: cam_from_rig (N, 3, 4), metres. The
    error is then that of the first view of a set.

    Of a set of one the label is that of a single image, but for the order of its matches, which are stored by landmark.
    Turns between looks are those of the table's poses; with `turn_noise_deg` they are told wrong by as much, drawn from
    the seed. The error is that of the look that is worst. `points` (N, 3) m are the landmarks', `confidence` is the one
    that ships unless given. The progress bar has a text; None shows none. Returns a row for each set, `SET_COLUMNS`.

    Raises a TableError if the table does not hold where landmarks were matched, a row is none of its own or of the
    points'; a PoseError if looks of a set are not of one place; a ConfigError for noise below zero.
    """
    missing = [name for name in (*MATCH_FIELDS.names[:1], PIXELS) if name not in table]
    if missing:
        fix = "Label with `--label.store_pixels true`, and read the table with `pixels=True`."
        raise TableError("it is not stored where landmarks were matched", value=missing, fix=fix)
    localizer = JointLocalizer(PoseEstimator(points, config), turn_noise_deg)
    told = confidence or Confidence.shipped()
    rng = np.random.default_rng(seed)
    true = poses(table)
    places = table["location_id"].to_numpy()
    numbers = table[CAMERA_ID].to_numpy() if CAMERA_ID in table and isinstance(cameras, Mapping) else None
    rows: list[tuple[object, ...]] = []
    alone: dict[int, Alone] = {}  # what each view finds alone, which many sets ask for
    known: dict[tuple[int, ...], tuple[object, ...]] = {}  # sets that come again, where nothing is drawn for each
    for number, taken in enumerate(tqdm(sets, desc=progress, unit="set", disable=progress is None)):
        chosen = np.asarray(taken, dtype=np.int64)
        if len(chosen) == 0 or chosen.min() < 0 or chosen.max() >= len(table):
            raise TableError(f"a set of looks names no rows of the table's {len(table)}", value=chosen.tolist())
        key = tuple(chosen.tolist())
        if key in known:
            rows.append(known[key])
            continue
        mounts = _told_turns(rig_of(true[chosen]), turn_noise_deg, rng) if rigs is None else rigs[number]
        looks = [
            _look(table, row, mount, cameras if numbers is None else cameras[int(numbers[row])], len(points))  # type: ignore[index, arg-type]
            for row, mount in zip(chosen, mounts, strict=True)
        ]
        start = time.perf_counter()
        for row, look in zip(key, looks, strict=True):
            if row not in alone:
                alone[row] = localizer.alone(look)
        found = localizer.localize(looks, [alone[row] for row in key])
        seconds = time.perf_counter() - start
        if found.cams_from_world is None:
            error_m = error_deg = np.array([np.nan])
        else:
            judged = slice(None) if rigs is None else slice(1)
            error_m, error_deg = pose_error(found.cams_from_world[judged], true[chosen][judged])
        numbers_of = (found.n_matches, found.n_inliers, found.support, found.elsewhere, *found.own, *found.deviation)
        values = (len(chosen), int(places[chosen[0]]), found.status, error_m.max(), error_deg.max(), *numbers_of)
        rows.append((*values, told.of(found), seconds))
        if turn_noise_deg == 0 and rigs is None:
            known[key] = rows[-1]
    return pd.DataFrame(rows, columns=list(SET_COLUMNS))


def _look(table: pd.DataFrame, row: int, mount: Float, camera: Camera, n_points: int) -> Look:
    landmarks = np.asarray(table["matched_rows"].iat[row], dtype=np.int64)
    pixels = np.asarray(table[PIXELS].iat[row], dtype=np.float64)
    fix = "Label the scene again, with its map of now."
    if len(pixels) != 2 * len(landmarks) or not np.isfinite(pixels).all():
        raise TableError("a view's pixels do not fit its matches", value=(len(pixels), len(landmarks)), fix=fix)
    if len(landmarks) and (landmarks.min() < 0 or landmarks.max() >= n_points):
        raise TableError(
            f"a view matched a landmark that the map of {n_points} lacks", value=int(landmarks.max()), fix=fix
        )
    return Look(mount, pixels.reshape(-1, 2), landmarks, camera)


def _told_turns(mounts: Float, turn_noise_deg: float, rng: np.random.Generator) -> Float:
    """Turns as a head that is off by as much would tell them; the first look's is the rig's, and exact."""
    if turn_noise_deg == 0:
        return mounts
    from scipy.spatial.transform import Rotation

    noise = Rotation.from_rotvec(np.radians(rng.normal(0, turn_noise_deg, (len(mounts), 3)))).as_matrix()
    noise[0] = np.eye(3)
    return np.concatenate([noise @ mounts[:, :, :3], mounts[:, :, 3:]], axis=2)
