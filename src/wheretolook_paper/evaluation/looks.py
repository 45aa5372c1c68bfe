"""Sets of views: strategies of selection, labels by joint localization, and tables by strategy and number of views.

Sets are localized jointly from the stored matches of single views (`--label.store_pixels true`), without rendering.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.viewpoint_files import MATCH_FIELDS
from wheretolook.dataset.viewpoint_table import CAMERA_ID, PIXELS, poses
from wheretolook.evaluation.statistics import ClusterBootstrap
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float, pose_error
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.estimation import PoseEstimator, SingleViewPoses
from wheretolook.localization.rig import Look, rig_of
from wheretolook.localization.rig_localization import JointLocalization, JointLocalizer
from wheretolook.looks.selection import Detections, Rotations, SetScoreModel, select_views
from wheretolook.tracking import BEST_TAG, NestedRun, TrackingConfig
from wheretolook.utils.errors import TableError
from wheretolook.utils.files import write_text
from wheretolook.utils.texts import markdown_table
from wheretolook_paper.evaluation.comparison import interval_text, log_comparison
from wheretolook_paper.fisher.metrics import metric_of

LOOKS_CSV = "looks.csv"
LOOKS_MD = "looks.md"

NUMBERS = (1, 2, 3, 5)
"""Compared numbers of views in a set."""

STRATEGIES = {
    "together": "chosen together, by what they see together",
    "in-turn": "one added after another, by what is seen with those before; none is exchanged",
    "one-by-one": "the best alone, at least 40° apart",
    "even": "spread evenly, from the best alone on",
    "visible": "the most different landmarks in view",
    "fisher": "exact Fisher information of the rig (log det)",
    "random": "drawn at random",
}

TOGETHER = "together"
"""The product's strategy."""


def look_table(sets: pd.DataFrame) -> pd.DataFrame:
    """Return the share of locations whose sets localize jointly, by strategy and number of views.

    Columns: `good` and its 95 % interval by resampling locations; `gain` over the best single view of the same
    locations, paired, and its interval; `any_good`; `sure`, the share of poses with a confidence of at least 99 %, and
    `sure_right`, the share of these that is right.
    """
    rows = []
    for (strategy, n), part in sets.groupby(["strategy", "n_looks"], sort=False):
        good = part["good"].to_numpy(float)
        values = np.stack([good, good - part["single_good"].to_numpy(float)], axis=1)
        bootstrap = ClusterBootstrap(np.arange(len(part)), 2000, 0)
        low, high = bootstrap.ratio_interval(values, np.ones((len(part), 1)))
        mean = values.mean(0)
        sure = part["confidence"] >= 0.99
        rows.append(
            {"strategy": strategy, "n_looks": n, "n_locations": len(part)}
            | {"good": mean[0], "good_low": low[0], "good_high": high[0]}
            | {"gain": mean[1], "gain_low": low[1], "gain_high": high[1]}
            | {"any_good": part["any_good"].mean(), "sure": sure.mean()}
            | {"sure_right": part.loc[sure, "good"].mean() if sure.any() else np.nan}
        )
    return pd.DataFrame(rows)


def stopping_table(sets: pd.DataFrame, asked: Sequence[float] = (0.5, 0.8, 0.9, 0.95, 0.99)) -> pd.DataFrame:
    """Return how many views are needed if the camera stops once the confidence reaches a limit.

    Uses sets whose views are added one after another ("in-turn"). Columns: `asked`, the limit; `looks`, the mean
    number; `good`, the share of locations; `of_most`, relative to the share of the largest sets.
    """
    in_turn = sets[sets["strategy"] == "in-turn"].sort_values("n_looks", kind="stable")
    locations = [part for _, part in in_turn.groupby(["scene", "location_id"])]
    most = np.mean([part["good"].iloc[-1] for part in locations]) if locations else np.nan
    rows: list[dict[str, float]] = []
    for limit in asked:
        stops = [
            part.iloc[int(np.argmax(np.append(part["confidence"].to_numpy()[:-1] >= limit, True)))]
            for part in locations
        ]
        good = float(np.mean([stop["good"] for stop in stops]))
        looks = float(np.mean([stop["n_looks"] for stop in stops]))
        rows.append({"asked": limit, "looks": looks, "good": good, "of_most": float(good / most)})
    return pd.DataFrame(rows)


def write_looks(folder: Path, sets: pd.DataFrame, title: str) -> pd.DataFrame:
    """Write `looks.csv` and `looks.md` of compared sets; return `look_table`."""
    table = look_table(sets)
    stopping = stopping_table(sets)
    write_text(folder / LOOKS_CSV, table.to_csv(index=False))
    shares = [
        [row["strategy"], str(row["n_looks"]), str(row["n_locations"]), interval_text(row, "good"),
         interval_text(row, "gain"), f"{100 * row['any_good']:.1f}", f"{100 * row['sure']:.1f}",
         "" if np.isnan(row["sure_right"]) else f"{100 * row['sure_right']:.1f}"]
        for row in table.to_dict("records")
    ]  # fmt: skip
    head = ["looks", "N", "places", "localized together", "over one look", "any alone", "sure", "of these right"]
    stops = [
        [f"{row['asked']:.2f}", f"{row['looks']:.2f}", f"{100 * row['good']:.1f}", f"{100 * row['of_most']:.1f}"]
        for row in stopping.to_dict("records")
    ]
    parts = [f"# {title}", markdown_table(head, shares)]
    parts += ["## When to stop", markdown_table(["asked", "looks", "localized", "of all looks' share"], stops)]
    write_text(folder / LOOKS_MD, "\n\n".join(parts) + "\n")
    return table


def log_looks(
    tracking: TrackingConfig,
    table: pd.DataFrame,
    params: Mapping[str, Any],
    files: Sequence[Path],
    tags: Mapping[str, str] | None = None,
) -> str:
    """Log a `look_table` as a run with files and a nested run for each row; return the run's id.

    The run has the metrics of the best strategy for the largest sets.
    """
    numbers = [name for name in ("good", "gain", "any_good", "sure", "sure_right") if name in table]
    best = table[table["n_looks"] == table["n_looks"].max()].nlargest(1, "good").iloc[0]
    nested = [
        NestedRun(
            f"{row['strategy']}, {row['n_looks']} looks",
            {**params, "strategy": row["strategy"], "n_looks": row["n_looks"]},
            {name: float(row[name]) for name in numbers},
        )
        for row in table.to_dict("records")
    ]
    metrics = {name: float(best[name]) for name in numbers}
    about = {"dataset": str(params["dataset"]), BEST_TAG: str(best["strategy"])}
    return log_comparison(tracking, "all sets", "looks", params, metrics, nested, files, tags, about)


def information_score(sums: Float, p_none: Float) -> Float:
    """Return the log determinant (B,) of the information in sums (B, N_SUMS)."""
    return metric_of(np.asarray(sums)[..., 1:], "logdet")


def count_score(sums: Float, p_none: Float) -> Float:
    """Return how many different landmarks are expected to be detected, (B,)."""
    return np.asarray(sums)[..., 0]


def best_separated(scores: Float, directions: Float, n: int) -> list[int]:
    """Return the n views with the best single-view scores (D,), 40 degrees apart if there are as many."""
    order = np.argsort(-np.asarray(scores), kind="stable").tolist()
    near = np.cos(np.radians(40.0))
    views: list[int] = []
    for view in order:
        if all(directions[view] @ directions[other] <= near for other in views):
            views.append(view)
    return (views + [view for view in order if view not in views])[:n]


def evenly_spread(directions: Float, n: int, first: int) -> list[int]:
    """Return n views spread from a first one on: always the one whose nearest is farthest."""
    views = [first]
    while len(views) < n:
        nearest = (directions @ directions[views].T).max(1)
        nearest[views] = np.inf
        views.append(int(nearest.argmin()))
    return views


def choose_set(
    strategy: str, n: int, axes: Float, scores: Float, views: Detections, certain: Detections, rng: np.random.Generator
) -> list[int]:
    """Return the rows of n views along axes (D, 3) with scores (D,) that a strategy of the tables chooses."""
    if strategy == "random":
        return [int(row) for row in rng.choice(len(axes), n, replace=False)]
    if strategy == "one-by-one":
        return best_separated(scores, axes, n)
    if strategy == "even":
        return evenly_spread(axes, n, int(np.argmax(scores)))
    rotations = Rotations(axes)
    if strategy in ("visible", "fisher"):
        objective = count_score if strategy == "visible" else information_score
        return list(select_views(certain, objective, n, rotations).rows)
    options = {"exchanges": 0} if strategy == "in-turn" else {}
    chosen = select_views(views, SetScoreModel.bundled(), n, rotations, single=scores, **options)
    return list(chosen.rows)


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
    "missing",
    "confidence",
    "seconds",
)
"""Columns of `label_sets`. `status`, `error_m` and `error_deg` are as for single viewpoints, so `is_good` applies to sets,
too; `elsewhere` is the rival support, `own` and `rival_own` are the unique support of pose and rival;
`missing` is that of `JointLocalization`, NaN if nothing can be expected."""


def label_sets(
    table: pd.DataFrame,
    sets: Sequence[Sequence[int] | NDArray[np.integer]],
    points: Float,
    cameras: Camera | Mapping[int, Camera],
    config: LocalizerConfig = LocalizerConfig(),
    progress: str | None = None,
    rigs: Sequence[Float] | None = None,
) -> pd.DataFrame:
    """Localize sets of a table's views jointly and measure the errors.

    A set has rows of the table with views of one location, whose relative rotations are those of the table; its error
    is that of the worst view. With `rigs`,
    cam_from_rig (N, 3, 4) in metres for each set, its views may be of several locations; its error is that of its
    first view. `points` (N, 3) m are the landmarks. A set of one view gets the label of a single image, up to the order
    of its matches. `progress` is the title of a progress bar. Returns a row per set, with `SET_COLUMNS`.

    Raises TableError if the table has no stored pixels or a row is invalid, PoseError if views of a set are not from
    one location.
    """
    missing = [name for name in (*MATCH_FIELDS.names[:1], PIXELS) if name not in table]
    if missing:
        fix = "Label with `--label.store_pixels true`, and read the table with `pixels=True`."
        raise TableError("the table has no pixels of matches", value=missing, fix=fix)
    localizer = JointLocalizer(PoseEstimator(points, config))
    true_poses = poses(table)
    locations = table["location_id"].tolist()
    single_view: dict[int, SingleViewPoses] = {}
    known: dict[tuple[int, ...], tuple[object, ...]] = {}  # repeated sets, if each has no rig of its own
    rows: list[tuple[object, ...]] = []
    for number, members in enumerate(tqdm(sets, desc=progress, unit="set", disable=progress is None)):
        key = tuple(map(int, members))
        if not key or max(key) >= len(table):
            raise TableError(f"a set of views has none or wrong rows of {len(table)}", value=key)
        if key not in known or rigs is not None:
            true = true_poses[list(key)]
            rig = rig_of(true) if rigs is None else rigs[number]
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
        np.nan if result.missing is None else result.missing,
        result.probability(),
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
