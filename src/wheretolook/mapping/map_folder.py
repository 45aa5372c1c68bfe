"""The last steps of making any map: filter its points, write the model, landmarks, poses, database and report."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheretolook.mapping.colmap_model import CAMERAS_FILE, LANDMARKS_FILE, colmap_poses, save_mapping_poses, write_model
from wheretolook.mapping.config import MapConfig, SourceImages
from wheretolook.mapping.feature_files import DATABASE_FILE, HDF5_SUFFIXES
from wheretolook.mapping.georeference import REPORT_FILE
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks
from wheretolook.utils.errors import MapError
from wheretolook.utils.files import atomic_folder, copy_file, write_text
from wheretolook.utils.processes import WorkerPool


class Clock:
    """Measures the steps of a map: `with clock("step"):` adds its wall-clock time to `seconds`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, step: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[step] = round(time.perf_counter() - start, 3)

    def with_total(self) -> dict[str, float]:
        """Wall-clock time of each step and their sum."""
        return {**self.seconds, "total": sum(self.seconds.values())}


@dataclass(frozen=True)
class MapRun:
    """Settings and resources that all steps of making one map share."""

    config: MapConfig | SourceImages
    processes: WorkerPool
    seed: int = 0
    device: str = "cpu"  # that extracts keypoints
    progress: bool = True
    clock: Clock = field(default_factory=Clock)


@dataclass(frozen=True)
class MapDraft:
    """A triangulated map in the world frame, before its points are filtered."""

    model: Any  # `pycolmap.Reconstruction`
    source: Path  # the folder that errors and warnings name
    max_error_px: float  # points with a larger mean reprojection error are removed; 0 keeps all
    fix: str  # what to do if no point is left
    database: Path | None  # of keypoints and descriptors; one in the map's own folder is kept only on request
    colors: Sequence[NDArray[np.uint8]] = ()  # (N_i, 3) of the keypoints of image i + 1, if points lack colours
    search_device: str = "cpu"  # that searches for similar descriptors


@dataclass(frozen=True)
class SavedReport:
    """What was done to make a map."""

    def save(self, folder: Path) -> None:
        """Write the report into a map's folder."""
        write_text(folder / REPORT_FILE, json.dumps(asdict(self), indent=2, default=str) + "\n")


@dataclass(frozen=True)
class MapReport(SavedReport):
    """Properties of a map from any source; `report.json`."""

    n_images: int  # rendered images, photographs, or images of the existing model with a pose
    n_landmarks: int  # landmarks after the filter
    n_landmarks_removed: int  # points the filter removed
    median_track_length: float  # observations of a landmark
    mean_reprojection_error_px: float  # mean over the landmarks
    seed: int  # seed of the walk and of COLMAP
    config: dict[str, Any]  # the configuration, as a dictionary
    seconds: dict[str, float]  # wall-clock time of each step


@contextmanager
def replacing_map(  # the parts of a `MapRun`, and the folder
    config: MapConfig | SourceImages,
    out_dir: str | Path,
    seed: int,
    workers: int,
    device: str,
    progress: bool,
    before_replace: Callable[[], None] = lambda: None,
) -> Iterator[tuple[Path, MapRun]]:
    """Yield a folder, which replaces the map in `out_dir` at the end of the block, and the resources for making it.

    Raises MapError if `out_dir`, or a file in its place, holds anything but a map of this project.
    """
    out_dir = Path(out_dir)
    if out_dir.exists() and not (out_dir / REPORT_FILE).is_file() and (not out_dir.is_dir() or any(out_dir.iterdir())):
        fix = "Give another folder, or remove it."
        raise MapError("will not be replaced, because it is not a map of this project", path=out_dir, fix=fix)
    with atomic_folder(out_dir, before_replace) as folder, WorkerPool(workers) as processes:
        yield folder, MapRun(config, processes, seed, device, progress)


def finish_map(draft: MapDraft, folder: Path, run: MapRun) -> tuple[Landmarks, dict[str, Any]]:
    """Filter a draft's points and write its model, landmarks, mapping poses and database into a folder.

    Returns the landmarks, and the fields of `MapReport` but for `n_images` and `seconds`. Raises MapError if the filter
    leaves no point.
    """
    model = draft.model
    with run.clock("filter_and_write"):
        n_removed = _remove_inaccurate(draft) if draft.max_error_px else 0
        if draft.colors:
            color_points(model, dict(enumerate(draft.colors, 1)))
        write_model(model, folder)
    with run.clock("landmarks"):
        landmarks = load_colmap_landmarks(draft.source, draft.database, None, draft.search_device, model, run.progress)
        landmarks.save(folder / LANDMARKS_FILE)
        save_mapping_poses(colmap_poses(draft.source, model), folder / CAMERAS_FILE)
    database = draft.database
    if database is not None and database.parent == folder and not run.config.keep_database:
        database.unlink()
    elif database is not None and database.parent != folder and run.config.keep_database:
        is_hdf5 = database.suffix.lower() in HDF5_SUFFIXES
        copy_file(database, folder / (database.name if is_hdf5 else DATABASE_FILE))
    return landmarks, {
        "n_landmarks": len(landmarks),
        "n_landmarks_removed": n_removed,
        "median_track_length": float(np.median(landmarks.track_length)),
        "mean_reprojection_error_px": float(landmarks.reprojection_error_px.mean()),
        "seed": run.seed,
        "config": run.config.report(),
    }


def _remove_inaccurate(draft: MapDraft) -> int:
    """Remove points with a larger mean reprojection error, and return their number. Raises MapError if none is left."""
    points = draft.model.points3D
    removed = [number for number, point in points.items() if not point.error <= draft.max_error_px]
    if len(removed) == len(points):
        value = f"{len(points)} triangulated, {len(removed)} removed"
        raise MapError("the images give no landmark", path=draft.source, value=value, fix=draft.fix)
    for number in removed:
        draft.model.delete_point3D(number)
    return len(removed)


def color_points(model: Any, colors: Mapping[int, NDArray[np.uint8]]) -> None:
    """Set the colour of each point of a reconstruction to the mean over its keypoints, (N, 3) uint8 of images by id.

    Points that none of these images observes stay as they are.
    """
    for point in model.points3D.values():
        track = [element for element in point.track.elements if element.image_id in colors]
        observed = [colors[element.image_id][element.point2D_idx] for element in track]
        if observed:
            point.color = np.rint(np.mean(observed, axis=0)).astype(np.uint8)
