"""Hold a block of photographs out of a map, and localize them against what remains; finished blocks are cached."""

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
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.thresholds import Accuracy
from wheretolook.dataset.viewpoint_table import LOCALIZED
from wheretolook.features.keypoints import Keypoints
from wheretolook.holdout.holdout_blocks import Block, choose_blocks
from wheretolook.holdout.photo_map import MAX_ERROR_DEG, MAX_ERROR_M, PhotographedMap
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.localizer import Localizer, localization_errors
from wheretolook.localization.versions import versions
from wheretolook.mapping.colmap_model import read_model, write_model
from wheretolook.mapping.feature_files import read_features
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks
from wheretolook.utils.artifact_cache import ArtifactCache, cache_key
from wheretolook.utils.errors import MapError, MapWarning
from wheretolook.utils.processes import WorkerPool

MIN_ANGLE_DEG = 1.5  # COLMAP's own minimum angle between the rays of a landmark
_FORMAT = 4  # version of what is cached of a block
_LANDMARKS = "landmarks.npz"
_VIEWS = "views.json"


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
class _Job:
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
    `choose_blocks`.
    """
    blocks = choose_blocks(source) if blocks is None else blocks
    limits = [source.limit_m.tolist(), MAX_ERROR_DEG, MIN_ANGLE_DEG, asdict(LocalizerConfig()), source.fov_deg]
    key = cache_key(_FORMAT, versions(), source.key, limits)
    folder = work / f"blocks-{key}"
    for old in work.glob("blocks-*"):
        if old.is_dir() and old != folder:
            shutil.rmtree(old)
    model = folder / "model"
    job_source = replace(source, model=None)
    results = dict[int, HoldoutResult | None]()
    jobs = list[_Job]()
    for block in blocks:
        cache = ArtifactCache(
            folder / f"{block.number:02}", cache_key(key, block.held_out.tolist(), block.tested.tolist())
        )
        results[block.number] = _load(cache, block)
        if results[block.number] is None:
            jobs.append(_Job(job_source, model, block, cache, device))
    jobs.sort(key=lambda job: -len(job.block.tested))  # no process is left with the largest block at the end
    if jobs:
        write_model(source.model, model)
    total = sum(len(block.tested) for block in blocks)
    left = sum(len(job.block.tested) for job in jobs)
    bar = tqdm(total=total, initial=total - left, desc="check: hold out, localize", unit="view")
    with bar, WorkerPool(max(1, min(workers, len(jobs)))) as pool:
        for job, _ in zip(jobs, pool.map(_run, jobs), strict=True):
            results[job.block.number] = _load(job.cache, job.block)
            bar.update(len(job.block.tested))
    shutil.rmtree(model, ignore_errors=True)
    return [result for result in results.values() if result is not None]


def judged(result: HoldoutResult, accuracy: Accuracy) -> HoldoutResult:
    """Return a result whose views are good within another accuracy; where metres are unknown, limits stay shares of depth."""
    views = result.views
    limit_m = views["limit_m"] * (accuracy[0] / MAX_ERROR_M)
    good = (views["status"] == LOCALIZED) & (views["error_m"] < limit_m) & (views["error_deg"] < accuracy[1])
    return replace(result, views=views.assign(good=good, limit_m=limit_m))


def without(model: Any, image_ids: Sequence[int]) -> Any:
    """Return a copy of a `pycolmap.Reconstruction` without some images and their influence on its landmarks.

    The frames of these images are removed with all their images. A landmark that loses an observation is triangulated
    again from the others; it is dropped if it has fewer than two, if its rays meet at less than `MIN_ANGLE_DEG`, or if
    it reprojects worse than any landmark of the whole map.
    """
    import pycolmap

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
    pycolmap.ObservationManager(rest).filter_points3D_with_small_triangulation_angle(MIN_ANGLE_DEG, set(changed))
    for number in changed:
        if number in rest.points3D:
            point = rest.points3D[number]
            if not (point.error <= worst_px and np.isfinite(point.xyz).all()):
                rest.delete_point3D(number)
    return rest


@lru_cache(maxsize=1)
def _model(folder: Path) -> Any:
    return read_model(folder)


def _run(job: _Job) -> None:
    """Hold out a block, localize its photographs, and store the result."""
    import torch

    torch.set_num_threads(1)
    whole = _model(job.model)
    image_ids = job.source.arrays.image_ids
    rest = without(whole, image_ids[job.block.held_out].tolist())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MapWarning)
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
    replace(landmarks, descriptors=None).save(job.cache.folder / _LANDMARKS)
    job.cache.store({_VIEWS: views.to_dict("list")})


def _observed(image: Any, source: PhotographedMap, row: int, crop: int) -> NDArray[np.int64]:
    """Return the ids of the landmarks that an image of a model observes in a view of it."""
    points = [point for point in image.points2D if point.has_point3D()]
    ids = np.array([point.point3D_id for point in points], dtype=np.int64)
    pixels = np.array([point.xy for point in points]).reshape(-1, 2)
    return np.unique(ids[source.pixels_in_view(row, crop, pixels)[1]])


def _localize(job: _Job, landmarks: Landmarks) -> pd.DataFrame:
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
    results = cache.load(_VIEWS)
    if results is None:
        return None
    try:
        return HoldoutResult(block, Landmarks.load(cache.folder / _LANDMARKS), pd.DataFrame(results[_VIEWS]))
    except (MapError, ValueError):
        return None
