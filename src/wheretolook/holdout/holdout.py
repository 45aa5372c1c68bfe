"""Choose blocks of neighbouring photographs to hold out, so that the rest covers them from well to badly."""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pycolmap
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from tqdm.auto import tqdm

from wheretolook.dataset.config import Accuracy
from wheretolook.dataset.viewpoint_table import LOCALIZED
from wheretolook.features.extractor import Keypoints
from wheretolook.geometry.lattices import spread_rows
from wheretolook.geometry.poses import Float, camera_centers
from wheretolook.holdout.photo_map import MAX_ERROR_DEG, MAX_ERROR_M, PhotographedMap
from wheretolook.localization.confidence import RIGHT_PLACE_LIMITS
from wheretolook.localization.config import LocalizerConfig, versions
from wheretolook.localization.localizer import Localizer, localization_errors
from wheretolook.mapping.colmap_model import observation_matrix, read_model, write_model
from wheretolook.mapping.config import MIN_TRIANGULATION_ANGLE_DEG
from wheretolook.mapping.feature_files import read_features
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks
from wheretolook.utils.errors import MapError, MapWarning
from wheretolook.utils.files import ArtifactCache, cache_key
from wheretolook.utils.processes import WorkerPool

KEPT = tuple(LocalizerConfig().min_inliers * share for share in (16, 8, 4, 2))
"""Landmarks that the rest may still have of what a photograph observes, at the lower quartile of each grown block: from
plenty for a pose to hardly enough, since not all are matched again."""
MIN_REST = 0.1  # share of the photographs that is never held out
MIN_LANDMARKS = 50  # of a map without a block
VIEWS = 60  # maximum number of photographs of a block that are localized; then evenly spread ones
_GOLDEN = 0.6180339887


@dataclass(frozen=True, eq=False)
class Block:
    """Photographs that are held out together, by their rows.

    Attributes:
        number: from 1.
        held_out: (B,) held-out photographs, ascending.
        tested: (V,) those of them that are localized, ascending.
        is_part: whether the block belongs to the partition of all photographs.
    """

    number: int
    held_out: NDArray[np.int64]
    tested: NDArray[np.int64]
    is_part: bool


def choose_blocks(source: PhotographedMap, views: int = VIEWS) -> list[Block]:
    """Choose 8 blocks of several sizes that partition the photographs, and 4 more, grown until the rest hardly covers them.

    Photographs are neighbours by shared landmarks, not by name or place: a second walk past the same wall is a
    neighbour, a photograph of the next room is not. A block grows by the photograph that shares most of its landmarks
    with the block. The sizes of the first 8 (fewer for few photographs) are a geometric progression. The others grow
    from four places until a quarter of their photographs observe at most `KEPT` landmarks that the rest still has, so
    that they hold well covered views at their edges and badly covered ones within. No block takes more than nine tenths
    of the photographs, and blocks that are mostly the same are chosen once. Photographs of a rig frame stay together.

    Raises MapError if fewer than two blocks leave a map.
    """
    observes = observation_matrix(source.arrays, source.rig_frame)
    shared = np.asarray((observes @ observes.T).toarray(), dtype=np.float64)
    counts = np.maximum(np.diag(shared).copy(), 1)
    np.fill_diagonal(shared, 0)
    share = shared / counts[:, None]  # of a frame's landmarks, those that it shares with each other frame
    centers = camera_centers(source.poses)
    sums = np.stack([np.bincount(source.rig_frame, weights=axis) for axis in centers.T], axis=1).astype(np.float64)
    places = sums / np.bincount(source.rig_frame)[:, None]
    parts = _partition(share, places)
    walk = np.concatenate(parts)  # all frames, neighbours next to one another
    groups = [(part, True) for part in parts]
    for number, kept in enumerate(KEPT, 1):
        first = int(walk[int(number * _GOLDEN % 1 * len(walk))])
        order = _grow(share, places, first, np.ones(len(share), dtype=bool))
        groups.append((order[: _block_size(observes, order, kept)], False))
    chosen = list[tuple[NDArray[np.int64], bool]]()
    for group, is_part in reversed(groups):  # of two that are the same, the one that is grown further is chosen
        held_out = np.flatnonzero(np.isin(source.rig_frame, group))
        if not _leaves_map(source, held_out, _landmarks_without(observes, group)):
            continue
        if not any(_same(held_out, other) for other, _ in chosen):
            chosen.append((held_out, is_part))
    _check_count(source, len(chosen))
    return [
        Block(number, held_out, held_out[spread_rows(len(held_out), views)], is_part)
        for number, (held_out, is_part) in enumerate(reversed(chosen), 1)
    ]


def _leaves_map(source: PhotographedMap, held_out: NDArray[np.int64], n_landmarks: int) -> bool:
    """Return whether the landmarks left without some photographs (rows) are enough for a map; a `MapWarning` if not."""
    if n_landmarks >= MIN_LANDMARKS:
        return True
    ends = f"{source.names[held_out[0]]} to {source.names[held_out[-1]]}"
    text = f"{source.path}: a block of {len(held_out)} photographs ({ends}) is not held out: {n_landmarks} landmarks"
    warnings.warn(f"{text} would be left, fewer than {MIN_LANDMARKS}", MapWarning, stacklevel=3)
    return False


def _check_count(source: PhotographedMap, n_blocks: int, n_needed: int = 2) -> None:
    """Raise MapError for fewer blocks than `n_needed`."""
    if n_blocks < n_needed:
        problem = f"without a block of neighbouring photographs fewer than {MIN_LANDMARKS} landmarks are left"
        fix = "Take more photographs, each part of the scene from several sides, and map them all."
        raise MapError(problem, path=source.path, value=f"{len(source.poses)} photographs", fix=fix)


def _same(one: NDArray[np.int64], other: NDArray[np.int64]) -> bool:
    return len(np.intersect1d(one, other)) >= 0.95 * len(np.union1d(one, other))


def _partition(share: Float, places: Float) -> list[NDArray[np.int64]]:
    """Partition all frames into blocks of neighbours; each grows from the frame least connected with the rest."""
    n = len(share)
    count = max(2, min(8, n // 2))
    weights = 4.0 ** (np.arange(count) / max(1, count - 1))  # the largest block is four times the smallest
    weights = weights[np.argsort(np.arange(1, count + 1) * _GOLDEN % 1, kind="stable")]  # large and small mixed
    ends = np.rint(np.cumsum(weights) / weights.sum() * n).astype(int)
    free = np.ones(n, dtype=bool)
    parts = []
    for size in np.diff(ends, prepend=0):
        rows = np.flatnonzero(free)
        if not size or not len(rows):
            continue
        loosest = rows[np.argmin(share[np.ix_(rows, rows)].sum(1))]
        block = _grow(share, places, int(loosest), free)[:size]
        free[block] = False
        parts.append(block)
    return parts


def _grow(share: Float, places: Float, first: int, free: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return all free frames in the order in which a block that starts with one of them takes them up.

    Next is the one with most of its landmarks in common with the block; ties go to the nearest to the first.
    """
    near = -np.linalg.norm(places - places[first], axis=1)
    near = near / max(1e-12, -near.min()) * 1e-6
    left = free.copy()
    bonds = share[:, first] + near
    order = [first]
    left[first] = False
    while left.any():
        following = int(np.argmax(np.where(left, bonds, -np.inf)))
        order.append(following)
        left[following] = False
        bonds = bonds + share[:, following]
    return np.array(order)


def _block_size(observes: csr_array, order: NDArray[np.int64], kept: float) -> int:
    """Return how many frames of a growing block to hold out, so that its worse covered quarter keeps `kept` landmarks."""
    low = 2
    high = max(2, int((1 - MIN_REST) * len(order)))
    while low < high:  # the larger the block, the less is left
        middle = (low + high) // 2
        if np.quantile(landmarks_kept(observes, order[:middle]), 0.25) <= kept:
            high = middle
        else:
            low = middle + 1
    while low > 2 and _landmarks_without(observes, order[:low]) < MIN_LANDMARKS:
        low = low * 9 // 10
    return low


def landmarks_kept(observes: csr_array, group: NDArray[np.int64]) -> NDArray[np.int64]:
    """Count, for each frame of a group, the observed landmarks that at least two of the other frames observe, too."""
    return np.asarray((observes[group] @ _remaining(observes, group)), dtype=np.int64).reshape(-1)


def _remaining(observes: csr_array, group: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.asarray(observes.sum(0) - observes[group].sum(0) >= 2, dtype=np.float64).reshape(-1)


def _landmarks_without(observes: csr_array, group: NDArray[np.int64]) -> int:
    return int(_remaining(observes, group).sum())


@dataclass(frozen=True, eq=False)
class HoldoutResult:
    """A block that was held out, the landmarks (without descriptors) of the remaining map, and its localized views.

    `views` has a row for each view of a tested photograph: row (of the photograph in the map), crop (of it, 0 is the
    middle one or itself), image (its name), status (of the localizer), good (whether it localized within the limits),
    error_m and error_deg (NaN without a pose), limit_m (of error_m), n_matches, n_inliers, n_observed (landmarks of the
    whole map that it observes), n_kept (those of them that the remaining map still has), and n_landmarks (of the
    remaining map).
    """

    block: Block
    landmarks: Landmarks
    views: pd.DataFrame


@dataclass(frozen=True, eq=False)
class _BlockJob:
    """Inputs of holding out one block in a worker process."""

    source: PhotographedMap  # without its model, which is in a folder
    model: Path
    block: Block
    cache: ArtifactCache
    device: str


def hold_out_blocks(
    source: PhotographedMap, work: Path, blocks: Sequence[Block] | None = None, workers: int = 1, device: str = "cpu"
) -> list[HoldoutResult]:
    """Hold out each block of a map and localize its photographs against the rest, with a progress bar.

    Observations of held-out photographs are removed from the tracks, and the affected landmarks are triangulated again
    (`without`). Landmarks, their attributes and descriptors then depend on the remaining photographs alone; poses and
    intrinsics are the whole map's. Finished blocks are cached in `work`. By default blocks are those of
    `choose_blocks`. A block without which too few landmarks can be triangulated, as in videos, is left out with a
    `MapWarning`. Raises MapError if fewer than two remain.
    """
    blocks = choose_blocks(source) if blocks is None else blocks
    limits = [
        source.limit_m.tolist(),
        MAX_ERROR_DEG,
        MIN_TRIANGULATION_ANGLE_DEG,
        asdict(LocalizerConfig()),
        source.fov_deg,
    ]
    key = cache_key(4, versions(), source.key, limits)  # version of what is cached of a block
    folder = work / f"blocks-{key}"
    for old in work.glob("blocks-*"):
        if old.is_dir() and old != folder:
            shutil.rmtree(old)
    model = folder / "model"
    job_source = replace(source, model=None)
    results = dict[int, HoldoutResult | None]()
    jobs = list[_BlockJob]()
    for block in blocks:
        cache = ArtifactCache(
            folder / f"{block.number:02}", cache_key(key, block.held_out.tolist(), block.tested.tolist())
        )
        results[block.number] = _load(cache, block)
        if results[block.number] is None:
            jobs.append(_BlockJob(job_source, model, block, cache, device))
    jobs.sort(key=lambda job: -len(job.block.tested))  # no process is left with the largest block at the end
    if jobs:
        write_model(source.model, model)
    total = sum(len(block.tested) for block in blocks)
    left = sum(len(job.block.tested) for job in jobs)
    bar = tqdm(total=total, initial=total - left, desc="check: hold out, localize", unit="view")
    with bar, WorkerPool(max(1, min(workers, len(jobs)))) as pool:
        for job, n_landmarks in zip(jobs, pool.map(_run, jobs), strict=True):
            if _leaves_map(source, job.block.held_out, n_landmarks):
                results[job.block.number] = _load(job.cache, job.block)
            bar.update(len(job.block.tested))
    shutil.rmtree(model, ignore_errors=True)
    finished = [result for result in results.values() if result is not None]
    _check_count(source, len(finished), min(2, len(blocks)))
    return finished


def judged(result: HoldoutResult, accuracy: Accuracy) -> HoldoutResult:
    """Return a result whose views are good within another accuracy, and at the right place within 0.5 m and 5 degrees.

    Where metres are unknown, limits stay shares of depth.
    """
    views = result.views

    def within(metres: float, degrees: float) -> pd.Series:
        near = views["error_m"] < views["limit_m"] * (metres / MAX_ERROR_M)
        return (views["status"] == LOCALIZED) & near & (views["error_deg"] < degrees)

    limit_m = views["limit_m"] * (accuracy[0] / MAX_ERROR_M)
    right_place = within(*RIGHT_PLACE_LIMITS)
    return replace(result, views=views.assign(good=within(*accuracy), right_place=right_place, limit_m=limit_m))


def without(model: Any, image_ids: Sequence[int]) -> Any:
    """Return a copy of a `pycolmap.Reconstruction` without some images and their influence on its landmarks.

    The frames of these images are removed with all their images. A landmark that loses an observation is triangulated
    again from the others; it is dropped if it has fewer than two, if its rays meet at less than `MIN_TRIANGULATION_ANGLE_DEG`, or if
    it reprojects worse than any landmark of the whole map.
    """
    rest = pycolmap.Reconstruction(model)
    before = {number: point.track.length() for number, point in rest.points3D.items()}
    worst_px = max((point.error for point in rest.points3D.values() if point.has_error()), default=np.inf)
    for frame in {rest.images[number].frame_id for number in image_ids}:
        rest.deregister_frame(frame)
    changed = [number for number, point in rest.points3D.items() if point.track.length() < before[number]]
    if not changed:
        return rest
    # images of points that are added one by one stay fixed
    adjusting = pycolmap.BundleAdjustmentConfig()
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    for number in changed:
        adjusting.add_variable_point(number)
    options.ceres.solver_options.num_threads = 1
    pycolmap.create_default_bundle_adjuster(options, adjusting, rest).solve()
    rest.update_point_3d_errors()
    observations = pycolmap.ObservationManager(rest)
    observations.filter_points3D_with_small_triangulation_angle(MIN_TRIANGULATION_ANGLE_DEG, set(changed))
    for number in changed:
        if number in rest.points3D:
            point = rest.points3D[number]
            if not (point.error <= worst_px and np.isfinite(point.xyz).all()):
                rest.delete_point3D(number)
    return rest


@lru_cache(maxsize=1)
def _model(folder: Path) -> Any:
    return read_model(folder)


def _run(job: _BlockJob) -> int:
    """Hold out a block, localize its photographs, and store the result. Returns the number of landmarks that are left.

    Nothing is localized and stored if that is below `MIN_LANDMARKS`.
    """
    torch.set_num_threads(1)
    whole = _model(job.model)
    image_ids = job.source.arrays.image_ids
    rest = without(whole, image_ids[job.block.held_out].tolist())
    if rest.num_points3D() < MIN_LANDMARKS:
        return int(rest.num_points3D())
    with warnings.catch_warnings(action="ignore", category=MapWarning):
        landmarks = load_colmap_landmarks(job.model, job.source.features, None, job.device, rest, progress=False)
    observed = [
        _observed(whole.images[int(image_ids[row])], job.source, row, crop)
        for row in job.block.tested.tolist()
        for crop in range(job.source.n_crops)
    ]
    views = _localize(job, landmarks).assign(
        n_observed=[len(ids) for ids in observed],
        n_kept=[int(np.isin(ids, landmarks.ids).sum()) for ids in observed],
        n_landmarks=len(landmarks),
    )
    job.cache.folder.mkdir(parents=True, exist_ok=True)
    job.cache.clear()
    replace(landmarks, descriptors=None).save(job.cache.folder / "landmarks.npz")
    job.cache.store({"views.json": views.to_dict("list")})
    return len(landmarks)


def _observed(image: Any, source: PhotographedMap, row: int, crop: int) -> NDArray[np.int64]:
    """Return the ids of the landmarks that an image of a model observes in a view of it."""
    points = [point for point in image.points2D if point.has_point3D()]
    ids = np.array([point.point3D_id for point in points], dtype=np.int64)
    pixels = np.array([point.xy for point in points]).reshape(-1, 2)
    return np.unique(ids[source.pixels_in_view(row, crop, pixels)[1]])


def _localize(job: _BlockJob, landmarks: Landmarks) -> pd.DataFrame:
    """Localize the tested photographs of a block against the remaining landmarks."""
    source = job.source
    tested = job.block.tested.tolist()
    localizer = Localizer(landmarks, source.cameras[tested[0]], device=job.device)
    kind, stored = read_features(source.features, [source.names[row] for row in tested])
    estimates = []
    poses = []
    for row, (pixels, descriptors) in zip(tested, stored, strict=True):
        for crop in range(source.n_crops):
            camera, pose = source.view(row, crop)
            moved, shown = source.pixels_in_view(row, crop, pixels)
            keypoints = Keypoints(moved[shown].astype(np.float32), kind.restore(descriptors[shown]))
            estimates.append(localizer.estimate(keypoints, localizer.match([keypoints])[0], camera))
            poses.append(pose)
    rows = np.repeat(job.block.tested, source.n_crops)
    error_m, error_deg = localization_errors(estimates, np.stack(poses))
    status = np.array([one.status for one in estimates])
    limit_m = source.limit_m[rows]
    return pd.DataFrame(
        {
            "row": rows,
            "crop": np.tile(np.arange(source.n_crops), len(tested)),
            "image": [source.names[row] for row in rows],
            "status": status,
            "good": (status == LOCALIZED) & (error_m < limit_m) & (error_deg < MAX_ERROR_DEG),
            "error_m": error_m,
            "error_deg": error_deg,
            "limit_m": limit_m,
            "n_matches": [len(one.matched_rows) for one in estimates],
            "n_inliers": [len(one.inlier_rows) for one in estimates],
        }
    )


def _load(cache: ArtifactCache, block: Block) -> HoldoutResult | None:
    """Read the cached result of a block; None if there is none, or it is unreadable."""
    results = cache.load("views.json")
    if results is None:
        return None
    try:
        return HoldoutResult(block, Landmarks.load(cache.folder / "landmarks.npz"), pd.DataFrame(results["views.json"]))
    except (MapError, ValueError):
        return None
