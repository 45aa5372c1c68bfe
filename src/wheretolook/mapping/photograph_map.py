"""Make a map from photographs alone: incremental mapping, gravity alignment, scale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wheretolook.geometry.poses import camera_centers
from wheretolook.geometry.similarity import Similarity
from wheretolook.mapping.colmap_model import colmap_poses, describe_cameras, registered_names
from wheretolook.mapping.config import MapConfig
from wheretolook.mapping.georeference import MapScale, MarkedPhotographs, check_tables
from wheretolook.mapping.gravity import estimate_gravity
from wheretolook.mapping.map_folder import MapDraft, MapReport, finish_map, replacing_map
from wheretolook.mapping.map_frame import IDENTITY, find_frame
from wheretolook.mapping.photographs import photograph_cameras
from wheretolook.mapping.sfm import map_incrementally, photograph_features
from wheretolook.utils.errors import ConfigError

_FIX = "Raise mapping.photographs.max_reprojection_error_px, or take sharper photographs."


@dataclass(frozen=True)
class PhotographMapReport(MapReport):
    """Properties of a map from photographs; `report.json`."""

    n_registered: int  # photographs that have a pose
    unregistered: list[str]  # names of the others
    model_sizes: list[int]  # photographs in each model that did not connect with another; the first is the map
    n_keypoints: int  # keypoints of all photographs
    cameras: list[dict[str, Any]]  # COLMAP's intrinsics of the reduced photographs
    n_known_focal: int  # cameras that started from a focal length that was given or is in the EXIF data
    gravity: dict[str, Any]  # "method" ("positions" or that of `Gravity`), "median_deg" and "max_deg" of its residuals
    scale: MapScale


def map_photographs(
    config: MapConfig,
    out_dir: str | Path = "map",
    work: Path = Path("photographs"),
    seed: int = 0,
    workers: int = 1,
    device: str = "cpu",
    progress: bool = True,
    before_replace: Callable[[], None] = lambda: None,
) -> PhotographMapReport:
    """Map the photographs in `config.photographs.images`.

    Writes what `build_map` writes, z up, and in metres if the report's scale has a source. Unless positions are given,
    the origin is the mean of the cameras' positions and the heading is arbitrary. Finished steps are cached in `work`.
    With one worker the same seed gives the same map; with more, COLMAP's bundle adjustment sums in any order. Raises
    MapError if photographs are unreadable, do not overlap or do not give the scale; ConfigError for invalid settings.
    """
    settings = config.photographs
    if settings.images is None:
        raise ConfigError("no folder of photographs was named", fix="Set mapping.photographs.images.")
    check_tables(settings.scale, config.frame)  # before the work
    with replacing_map(config, out_dir, seed, workers, device, progress, before_replace) as (folder, run):
        with run.clock("extract"):
            features = photograph_features(settings.images, work, run)
        with run.clock("map"):
            cameras = photograph_cameras(settings.images, features.names, features.full_sizes, features.sizes, settings)
            mapped = map_incrementally(work, features, cameras, run)
        model = mapped.model
        with run.clock("gravity"):
            poses = colmap_poses(work, model)
            gravity = estimate_gravity(poses, settings.up_in_camera)
            center = camera_centers(poses).mean(0)
            Similarity(1.0, gravity.rotation, -gravity.rotation @ center).transform_model(model)
        with run.clock("scale"):
            photographs = MarkedPhotographs(settings.scale, settings.images, progress=progress)
            options = config.frame if config.frame.positions else replace(config.frame, up="z")
            frame = find_frame(work, model, options, photographs=photographs)
            frame.world_from_map.transform_model(model)
            model.update_point_3d_errors()
        out_dir = Path(out_dir)
        draft = MapDraft(model, out_dir, settings.max_reprojection_error_px, _FIX, mapped.database, features.colors)
        landmarks, fields = finish_map(draft, folder, run)
        registered = set(registered_names(model).values())
        report = PhotographMapReport(
            n_images=len(features.names),
            **fields,
            seconds=run.clock.with_total(),
            n_registered=len(registered),
            unregistered=[name for name in features.names if name not in registered],
            model_sizes=mapped.model_sizes,
            n_keypoints=sum(len(pixels) for pixels, _ in features.stored),
            cameras=describe_cameras(model),
            n_known_focal=cameras.n_known_focal,
            gravity={
                "method": "positions" if config.frame.positions else gravity.method,
                "median_deg": float(np.median(gravity.residual_deg)),
                "max_deg": float(gravity.residual_deg.max()),
            },
            scale=frame.scale,
        )
        report.save(folder)
    IDENTITY.warn(out_dir, landmarks.mapping_distance_m, colmap_poses(work, model))
    return report
