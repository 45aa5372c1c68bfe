"""Leaves a block of photographs out of a map, and localizes them against what remains. Finished blocks are kept."""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.viewpoint_table import LOCALIZED
from wheretolook.features.keypoints import Keypoints
from wheretolook.geometry.camera import Camera
from wheretolook.geometry.poses import Float, pose_error
from wheretolook.holdout.holdout_blocks import VIEWS, Block, choose_blocks
from wheretolook.holdout.photo_map import MAX_ERROR_DEG, PhotographedMap, digest_of
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.labeller import versions
from wheretolook.localization.localizer import Localizer
from wheretolook.mapping.colmap_model import read_model, write_model
from wheretolook.mapping.feature_files import read_features
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks
from wheretolook.utils.errors import MapError, MapWarning
from wheretolook.utils.files import fingerprint, write_json, write_text
from wheretolook.utils.npz_files import load_npz, save_npz
from wheretolook.utils.processes import WorkerPool
from wheretolook.utils.reading import read_json_object

MIN_ANGLE_DEG = 1.5  # COLMAP's own least angle between the rays of a landmark
_FORMAT = 1  # raise it if what is stored of a block changes, or means something else
_FILES = ("landmarks.npz", "matches.npz", "views.csv")
_WHOLE = "whole.json"  # their fingerprints, so that a damaged one is made anew; written last
_NUMBERS = ("row", "error_m", "error_deg", "limit_m", "n_matches", "n_inliers", "n_observed", "n_kept", "n_landmarks")


@dataclass(frozen=True, eq=False)
class LeftOut:
    """A block that was left out, the map without it, and how its photographs localized in that.

    `views` has a row for each photograph looked at: row (of the photograph in the map), image, status, good (whether
    localized within the limits), error_m, error_deg, limit_m, n_matches, n_inliers, n_observed (landmarks of the whole
    map that it observes), n_kept (those of them that the map without the block still has), n_landmarks (of that map).
    `matched_rows` and `inlier_rows` are rows of the landmarks, of each view; `kept_rows` those behind n_kept: what the
    view is known to show, whether or not the localizer found it.
    """

    block: Block
    landmarks: Landmarks  # without descriptors
    views: pd.DataFrame
    matched_rows: list[NDArray[np.int64]]
    inlier_rows: list[NDArray[np.int64]]
    kept_rows: list[NDArray[np.int64]]


@dataclass(frozen=True, eq=False)
class _Job:
    """All that a process needs to leave out a block."""

    model: Path
    features: Path
    block: Block
    names: list[str]  # of the photographs looked at
    cameras: list[Camera]
    poses: Float
    limits: Float
    folder: Path
    device: str


def left_out_blocks(
    source: PhotographedMap, work: Path, views: int = VIEWS, workers: int = 1, device: str = "cpu"
) -> list[LeftOut]:
    """Leave all blocks out of a map, with a progress bar; finished ones are kept in `work`."""
    blocks = choose_blocks(source, views)
    found = []
    total = sum(len(block.looked_at) for block in blocks)
    with tqdm(total=total, desc="check: leave out, localize", unit="view") as bar:
        for one in leave_out(source, blocks, work, workers, device):
            found.append(one)
            bar.update(len(one.views))
    return found


def leave_out(
    source: PhotographedMap, blocks: Sequence[Block], work: Path, workers: int = 1, device: str = "cpu"
) -> Iterator[LeftOut]:
    """Leave out each of some blocks, and localize its photographs against the rest. Yields them in their order.

    Observations of the photographs left out are taken from the tracks. A landmark that loses one is placed anew by
    those that remain; it is left out if it has fewer than two, if its rays meet at less than 1.5 degrees, or if it
    reprojects worse than any landmark of the whole map. Landmarks, their attributes and descriptors follow from what
    remains alone; poses and intrinsics are the whole map's. Finished blocks are kept in `work`, and not done again.
    """
    work.mkdir(parents=True, exist_ok=True)
    folder = work / f"blocks-{_key(source)}"
    for old in work.iterdir():
        if old.is_dir() and old.name.startswith("blocks-") and old != folder:
            shutil.rmtree(old)
    model = folder / "model"
    jobs = list[_Job]()
    open_blocks = set[int]()
    for block in blocks:
        rows = block.looked_at
        place = folder / f"{block.number:02}"
        if not _is_finished(place, block):
            cameras = [source.cameras[row] for row in rows]
            about = (source.poses[rows], source.limit_m[rows], place, device)
            jobs.append(_Job(model, source.features, block, [source.names[row] for row in rows], cameras, *about))
            open_blocks.add(block.number)
    if jobs:
        write_model(source.model, model)
    with WorkerPool(max(1, min(workers, len(jobs)))) as processes:
        # the largest first, so that no process works alone at the end
        jobs.sort(key=lambda job: -len(job.block.looked_at))
        done = processes.map(_run, jobs)
        for block in blocks:
            while block.number in open_blocks:
                open_blocks.discard(next(done))
            yield _load(folder / f"{block.number:02}", block)
    shutil.rmtree(model, ignore_errors=True)


def without(model: Any, image_ids: Sequence[int]) -> Any:
    """A copy of a `pycolmap.Reconstruction` without images of some ids, and what only they have told of its landmarks.

    See `leave_out`. The moments that the images belong to go with all their images.
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
    # points that are added alone are observed by images that stay as they are
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


def _key(source: PhotographedMap) -> str:
    """Changes with all that decides what is stored of a block but the block itself, which is stored with it."""
    limits = [source.limit_m.tolist(), MAX_ERROR_DEG, MIN_ANGLE_DEG, asdict(LocalizerConfig())]
    return digest_of([_FORMAT, versions(), source.key, limits])


@lru_cache(maxsize=1)
def _model(folder: Path) -> Any:
    return read_model(folder)


def _run(job: _Job) -> int:
    """Leave out a block, localize its photographs, and write what came out. Returns the block's number."""
    import torch

    torch.set_num_threads(1)
    whole = _model(job.model)
    block = job.block
    image_ids = np.array(sorted(number for number, image in whole.images.items() if image.has_pose))
    rest = without(whole, image_ids[block.left_out].tolist())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MapWarning)
        landmarks = load_colmap_landmarks(job.model, job.features, None, job.device, rest, progress=False)
    localizer = Localizer(landmarks, job.cameras[0], device=job.device)
    rows = []
    matched = list[NDArray[np.int64]]()
    inliers = list[NDArray[np.int64]]()
    kept = list[NDArray[np.int64]]()
    kind, stored = read_features(job.features, job.names)
    for place, (pixels, descriptors) in enumerate(stored):
        keypoints = Keypoints(pixels, kind.restore(descriptors), np.ones(len(pixels), np.float32))
        found = localizer.estimate(keypoints, *localizer.match([keypoints])[0], camera=job.cameras[place])
        pose = np.full((3, 4), np.nan) if found.cam_from_world is None else found.cam_from_world
        error_m, error_deg = (float(error) for error in pose_error(pose, job.poses[place]))
        good = found.status == LOCALIZED and error_m < job.limits[place] and error_deg < MAX_ERROR_DEG
        image = whole.images[int(image_ids[block.looked_at[place]])]
        observed = np.unique([point.point3D_id for point in image.points2D if point.has_point3D()]).astype(np.int64)
        at = np.searchsorted(landmarks.ids, observed)
        at = at[landmarks.ids[np.minimum(at, len(landmarks) - 1)] == observed]
        row = {
            "row": int(block.looked_at[place]),
            "image": job.names[place],
            "status": found.status,
            "good": bool(good),
        }
        row |= {"error_m": error_m, "error_deg": error_deg, "limit_m": float(job.limits[place])}
        row |= {"n_matches": found.n_matches, "n_inliers": len(found.inlier_rows), "n_observed": len(observed)}
        rows.append({**row, "n_kept": len(at), "n_landmarks": len(landmarks)})
        matched.append(found.matched_rows)
        inliers.append(found.inlier_rows)
        kept.append(at)
    job.folder.mkdir(parents=True, exist_ok=True)
    replace(landmarks, descriptors=None).save(job.folder / "landmarks.npz")
    matches = {"left_out": block.left_out, "looked_at": block.looked_at}
    for name, parts in (("matched", matched), ("inliers", inliers), ("kept", kept)):
        matches |= {f"{name}_rows": np.concatenate(parts).astype(np.int64)}
        matches |= {f"{name}_counts": np.array([len(part) for part in parts], dtype=np.int64)}
    save_npz(job.folder / "matches.npz", matches)
    write_text(job.folder / "views.csv", pd.DataFrame(rows).to_csv(index=False))
    write_json(job.folder / _WHOLE, {name: fingerprint(job.folder / name) for name in _FILES})
    return block.number


def _is_finished(folder: Path, block: Block) -> bool:
    """Whether all files of a block are there, and whole; of an earlier version, as far as they tell themselves."""
    if not all((folder / name).is_file() for name in _FILES):
        return False
    try:
        if (folder / _WHOLE).is_file():
            whole = {name: fingerprint(folder / name) for name in _FILES}
            if read_json_object(folder / _WHOLE) != whole:
                return False
        kept = load_npz(folder / "matches.npz")
        return all(np.array_equal(kept[name], getattr(block, name)) for name in ("left_out", "looked_at"))
    except (OSError, ValueError, KeyError):
        return False


def _load(folder: Path, block: Block) -> LeftOut:
    try:
        kept = load_npz(folder / "matches.npz")
        views = pd.read_csv(folder / "views.csv")
        split = {
            name: np.split(kept[f"{name}_rows"], np.cumsum(kept[f"{name}_counts"])[:-1])
            for name in ("matched", "inliers", "kept")
        }
        landmarks = Landmarks.load(folder / "landmarks.npz")
        _check_rows(views, split, len(landmarks), block)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise MapError(f"damaged results of a block: {error}", path=folder, fix="Remove the folder.") from error
    return LeftOut(block, landmarks, views, split["matched"], split["inliers"], split["kept"])


def _check_rows(views: pd.DataFrame, split: Mapping[str, list[NDArray[Any]]], n_landmarks: int, block: Block) -> None:
    """ValueError or KeyError unless views are those of a block, and what they matched is in its map."""
    if not np.array_equal(views["row"], block.looked_at) or views["good"].dtype != bool:
        raise ValueError("views.csv is of other photographs")
    views[list(_NUMBERS)].to_numpy(np.float64)
    for name, rows in split.items():
        together = np.concatenate([*rows, np.zeros(0, dtype=np.int64)])
        if (
            len(rows) != len(views)
            or together.dtype != np.int64
            or not ((together >= 0) & (together < n_landmarks)).all()
        ):
            raise ValueError(f"matches.npz has no {name} landmarks of this map")
