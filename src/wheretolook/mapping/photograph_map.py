"""A map from photographs alone: mapped incrementally, turned upright, given a scale."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wheretolook.mapping import rendered_map as building
from wheretolook.mapping.colmap_model import describe_intrinsics, registered_names, write_model
from wheretolook.mapping.config import EXHAUSTIVE_UP_TO, MapConfig
from wheretolook.mapping.frame import KnownScale, find_scale
from wheretolook.mapping.gravity import estimate_gravity
from wheretolook.mapping.photographs import photograph_cameras
from wheretolook.mapping.rendered_map import DATABASE_FILE, REPORT_FILE, Clock
from wheretolook.mapping.scale import MapScale, Similarity
from wheretolook.mapping.sfm import map_incrementally, photograph_features
from wheretolook.mapping.triangulation import color_points
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import atomic_folder, copy_file, write_text
from wheretolook.utils.processes import WorkerPool


@dataclass(frozen=True)
class PhotographMapReport:
    """What came out of mapping photographs; `report.json`."""

    n_images: int  # photographs in the folder
    n_registered: int  # photographs the map could place
    unregistered: list[str]  # names of the others
    model_sizes: list[int]  # photographs in each model that did not connect with another; the first is the map
    n_keypoints: int  # keypoints of all photographs
    n_landmarks: int  # landmarks after the filter
    n_landmarks_removed: int  # points the filter removed
    median_track_length: float  # observations of a landmark
    mean_reprojection_error_px: float  # mean over the landmarks
    cameras: list[dict[str, Any]]  # COLMAP's intrinsics of the reduced photographs
    n_known_focal: int  # how many of the cameras started from a focal length that was given or is in the EXIF data
    gravity: dict[str, Any]  # "method" ("positions" or that of `Gravity`), "median_deg" and "max_deg" of its residuals
    scale: MapScale
    seed: int  # seed of COLMAP
    config: dict[str, Any]  # the configuration, as a dictionary
    seconds: dict[str, float]  # wall-clock time of each step


def map_photographs(
    config: MapConfig,
    out_dir: str | Path = "map",
    work: str | Path = "photographs",
    seed: int = 0,
    workers: int = 1,
    device: str = "cpu",
    progress: bool = True,
    replacing: Callable[[], None] = lambda: None,
) -> PhotographMapReport:
    """Map the photographs in `config.photographs.images`.

    The result is what `build_map` makes: a COLMAP model with `landmarks.npz`, `cameras.npz` and `report.json`, which is
    also returned, beside it; z up, and in metres if the report's scale has a source. The folder appears when all is
    done, and replaces an earlier map. Unless positions are given, the origin is the mean of the cameras' positions and
    the heading is arbitrary. Finished steps are kept in `work`, so that another run, for instance with another source
    of scale, does not start over.

    Of `config`, only `photographs`, `extractor` and `keep_database` count. As many threads as `workers` adjust bundles:
    with one worker the same seed gives the same map; with more, COLMAP sums large problems in another order each time.
    `replacing` is called when all is done, right before the folder changes.

    Raises MapError if the photographs are missing, unreadable or do not overlap, if they do not give the scale asked
    for, or if `out_dir` holds something that is not a map; ConfigError if a table of markers or positions is damaged,
    or there is no such camera model or dictionary.
    """
    settings = config.photographs
    out_dir = Path(out_dir)
    work = Path(work)
    clock = Clock()
    if settings.images is None:
        raise ConfigError("no folder of photographs was named", fix="Set map.photographs.images.")
    building.refuse_foreign_folder(out_dir)
    known = KnownScale.read(settings.scale)  # a damaged table is reported before the work
    work.mkdir(parents=True, exist_ok=True)
    with atomic_folder(out_dir, replacing) as partial, WorkerPool(workers) as processes:
        with clock("extract"):
            side_px = settings.max_side_px
            extractor = config.extractor
            features = photograph_features(settings.images, work, side_px, extractor, processes, device, progress)
        with clock("map"):
            cameras = photograph_cameras(settings.images, features.names, features.full_sizes, features.sizes, settings)
            matched = EXHAUSTIVE_UP_TO, settings.overlap
            mapped = map_incrementally(work, features, cameras, *matched, seed, processes, progress)
        model = mapped.model
        names = registered_names(mapped.model)
        with clock("gravity"):
            poses = np.stack([model.images[number].cam_from_world().matrix() for number in names])
            gravity = estimate_gravity(poses, settings.up_in_camera)
            centers = np.stack([model.images[number].projection_center() for number in names])
            upright = Similarity(1.0, gravity.rotation, -gravity.rotation @ centers.mean(0))
        with clock("scale"):
            scale, to_world = find_scale(model, known, upright, settings.images, progress=progress)
            to_world.transform_model(model)
        with clock("filter_and_write"):
            model.update_point_3d_errors()
            fix = "Raise map.photographs.max_reprojection_error_px, or take sharper photographs."
            n_removed = building.remove_inaccurate(model, settings.max_reprojection_error_px, out_dir, fix)
            color_points(model, features.colors)
            write_model(model, partial)
        with clock("landmarks"):
            landmarks = building.save_landmarks(partial, mapped.database, settings.max_reprojection_error_px)
        if config.keep_database:
            copy_file(mapped.database, partial / DATABASE_FILE)
        off_deg = gravity.residual_deg
        upright_by = {"median_deg": float(np.median(off_deg)), "max_deg": float(off_deg.max())}
        registered = set(names.values())
        report = PhotographMapReport(
            n_images=len(features.names),
            n_registered=len(registered),
            unregistered=[name for name in features.names if name not in registered],
            model_sizes=mapped.model_sizes,
            n_keypoints=sum(len(pixels) for pixels, _ in features.stored),
            n_landmarks=len(landmarks),
            n_landmarks_removed=n_removed,
            median_track_length=float(np.median(landmarks.track_length)),
            mean_reprojection_error_px=float(landmarks.reprojection_error_px.mean()),
            cameras=[describe_intrinsics(camera) for _, camera in sorted(model.cameras.items())],
            n_known_focal=cameras.n_known_focal,
            gravity={"method": "positions" if known.positions else gravity.method, **upright_by},
            scale=scale,
            seed=seed,
            config=asdict(config),
            seconds={**clock.seconds, "total": sum(clock.seconds.values())},
        )
        write_text(partial / REPORT_FILE, json.dumps(asdict(report), indent=2, default=str) + "\n")
    return report
