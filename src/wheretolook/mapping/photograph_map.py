"""A map from photographs alone: mapped incrementally, turned upright, given a scale."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from wheretolook.geometry.poses import Float
from wheretolook.mapping import building
from wheretolook.mapping import scale as scales
from wheretolook.mapping.building import DATABASE_FILE, REPORT_FILE, Clock
from wheretolook.mapping.config import MapConfig, ScaleConfig
from wheretolook.mapping.gravity import estimate_gravity
from wheretolook.mapping.incremental import MappedPhotographs, map_incrementally, photograph_features
from wheretolook.mapping.markers import Marker, MarkerView, detect_markers, marker_detector, place_marker
from wheretolook.mapping.photographs import photograph_cameras, read_photograph
from wheretolook.mapping.scale import MapScale, Similarity
from wheretolook.mapping.triangulation import color_points
from wheretolook.utils.errors import ConfigError, MapError
from wheretolook.utils.processes import Processes


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
) -> PhotographMapReport:
    """Map the photographs in `config.photographs.images`.

    The result is what `build_map` makes: a COLMAP model with `landmarks.npz`, `cameras.npz` and `report.json`, which is
    also returned, beside it; z up, and in metres if the report's scale has a source. The folder appears when all is
    done, and replaces an earlier map. Unless positions are given, the origin is the mean of the cameras' positions and
    the heading is arbitrary. Finished steps are kept in `work`, so that another run, for instance with another source
    of scale, does not start over.

    Of `config`, only `photographs`, `extractor` and `keep_database` count. As many threads as `workers` adjust bundles:
    with one worker the same seed gives the same map; with more, COLMAP sums large problems in another order each time.

    Raises MapError if the photographs are missing, unreadable or do not overlap, if they do not give the scale asked
    for, or if `out_dir` holds something that is not a map; ConfigError if a table of markers or positions is damaged,
    or there is no such camera model or dictionary.
    """
    settings, out_dir, work, clock = config.photographs, Path(out_dir), Path(work), Clock()
    if settings.images is None:
        raise ConfigError("no folder of photographs was named", fix="Set map.photographs.images.")
    building.refuse_foreign_folder(out_dir)
    known = _KnownScale.read(settings.scale)  # a damaged table is reported before the work
    work.mkdir(parents=True, exist_ok=True)
    with building.partial_folder(out_dir) as partial, Processes(workers) as processes:
        with clock("extract"):
            side_px, extractor = settings.max_side_px, config.extractor
            features = photograph_features(settings.images, work, side_px, extractor, processes, device, progress)
        with clock("map"):
            cameras = photograph_cameras(settings.images, features.names, features.full_sizes, features.sizes, settings)
            matched = settings.exhaustive_up_to, settings.overlap
            mapped = map_incrementally(work, features, cameras, *matched, seed, processes, progress)
        model, names = mapped.model, _registered(mapped)
        with clock("gravity"):
            poses = np.stack([model.images[number].cam_from_world().matrix() for number in names])
            gravity = estimate_gravity(poses, settings.up_in_camera)
            centers = np.stack([model.images[number].projection_center() for number in names])
            upright = Similarity(1.0, gravity.rotation, -gravity.rotation @ centers.mean(0))
        with clock("scale"):
            scale, to_world = _scale(mapped, settings.images, known, upright, features.full_sizes, progress)
            to_world.transform_model(model)
        with clock("filter_and_write"):
            model.update_point_3d_errors()
            fix = "Raise map.photographs.max_reprojection_error_px, or take sharper photographs."
            n_removed = building.remove_inaccurate(model, settings.max_reprojection_error_px, out_dir, fix)
            color_points(model, features.colors)
            model.write_binary(str(partial))
        with clock("landmarks"):
            landmarks = building.save_landmarks(partial, mapped.database, settings.max_reprojection_error_px)
        if config.keep_database:
            shutil.copyfile(mapped.database, partial / DATABASE_FILE)
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
            cameras=[_describe(camera) for _, camera in sorted(model.cameras.items())],
            n_known_focal=cameras.n_known_focal,
            gravity={"method": "positions" if known.positions else gravity.method, **upright_by},
            scale=scale,
            seed=seed,
            config=asdict(config),
            seconds={**clock.seconds, "total": sum(clock.seconds.values())},
        )
        (partial / REPORT_FILE).write_text(json.dumps(asdict(report), indent=2, default=str) + "\n")
    return report


@dataclass(frozen=True, eq=False)
class _KnownScale:
    """The settings that give the scale, with the tables they name."""

    config: ScaleConfig
    sizes_m: Mapping[int, float] | float
    positions: Mapping[str, Float]

    @staticmethod
    def read(config: ScaleConfig) -> _KnownScale:
        if config.has_marker_sizes or (config.distance is not None and config.distance.marker_ids):
            marker_detector(config.dictionary)  # raises if there is no such dictionary
        sizes = config.marker_size_m if config.marker_table is None else scales.read_marker_table(config.marker_table)
        return _KnownScale(config, sizes, {} if config.positions is None else scales.read_positions(config.positions))


def _scale(
    mapped: MappedPhotographs, folder: Path, known: _KnownScale, upright: Similarity, full_sizes: Any, progress: bool
) -> tuple[MapScale, Similarity]:
    """The scale, and the similarity from COLMAP's frame to the world."""
    model, names, config = mapped.model, _registered(mapped), known.config
    centers = {name: model.images[number].projection_center() for number, name in names.items()}
    if known.positions:
        return scales.scale_from_positions(centers, known.positions, config.tolerance_percent)
    scale = MapScale()
    if config.has_marker_sizes:
        views = _marker_views(mapped, folder, config.dictionary, full_sizes, progress)
        if not isinstance(known.sizes_m, float | int):
            views = {marker: seen for marker, seen in views.items() if marker in known.sizes_m}
        markers, unused = _place(views)
        scale = scales.scale_from_markers(markers, known.sizes_m, config.tolerance_percent, unused)
    elif config.distance is not None:
        wanted = config.distance.marker_ids
        views = _marker_views(mapped, folder, config.dictionary, full_sizes, progress) if wanted else {}
        names_of_ends = config.distance.first, config.distance.second
        first, second = (_place_of(end, centers, views, folder) for end in names_of_ends)
        scale = scales.scale_from_distance(first, second, config.distance.distance_m)
    return scale, replace(upright, scale=scale.factor, translation=scale.factor * upright.translation)


def _marker_views(
    mapped: MappedPhotographs, folder: Path, dictionary: str, full_sizes: Any, progress: bool
) -> dict[int, list[MarkerView]]:
    """Views of markers in photographs with a pose, by marker. Found at full size, given in pixels of the map."""
    found: dict[int, list[MarkerView]] = {}
    for number, name in tqdm(_registered(mapped).items(), "map: markers", disable=not progress, unit="image"):
        image = mapped.model.images[number]
        camera = mapped.model.cameras[image.camera_id]
        reduction = np.array([camera.width, camera.height]) / full_sizes[number - 1]
        rgb = read_photograph(folder / name)
        for marker, corners in detect_markers(rgb, dictionary, folder / name).items():
            view = MarkerView(name, camera, image.cam_from_world().matrix(), corners * reduction)
            found.setdefault(marker, []).append(view)
    return dict(sorted(found.items()))


def _place(views: Mapping[int, list[MarkerView]]) -> tuple[list[Marker], dict[str, str]]:
    """Markers placed, and why others could not be placed: a false detection in one photograph must not stop the map."""
    markers, unused = [], {}
    for marker, seen in views.items():
        try:
            markers.append(place_marker(marker, seen))
        except MapError as error:
            unused[f"marker {marker}"] = f"{error.problem}: {error.value}"
    return markers, unused


def _place_of(end: str, centers: Mapping[str, Float], views: Mapping[int, list[MarkerView]], folder: Path) -> Float:
    """Where an end of a known distance is, (3,) in COLMAP's frame."""
    if end.startswith("marker:"):
        number = int(end.removeprefix("marker:"))
        if number not in views:
            problem = f"no placed photograph sees marker {number}"
            raise MapError(problem, path=folder, value=end, fix="Name another.")
        return place_marker(number, views[number]).center
    if end not in centers:
        fix = "Name one that was placed, relative to its folder; markers are written marker:7."
        raise MapError("the map has no such photograph", path=folder, value=end, fix=fix)
    return centers[end]


def _registered(mapped: MappedPhotographs) -> dict[int, str]:
    """Names of the photographs with a pose, by id, in the order of ids."""
    return {number: image.name for number, image in sorted(mapped.model.images.items()) if image.has_pose}


def _describe(camera: Any) -> dict[str, Any]:
    size = {"model": camera.model_name, "width": camera.width, "height": camera.height}
    return {**size, "params": [float(value) for value in camera.params]}
