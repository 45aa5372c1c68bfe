"""Add photographs to an existing model, whose poses and cameras stay as they are."""

from __future__ import annotations

import filecmp
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from wheretolook.features.extractor import ExtractorConfig, Stored, kind_of
from wheretolook.geometry.camera import mean_focal_px
from wheretolook.mapping.colmap_model import holds_model, read_model, registered_names, write_model
from wheretolook.mapping.config import EXHAUSTIVE_UP_TO, PhotographsConfig
from wheretolook.mapping.feature_files import read_features
from wheretolook.mapping.georeference import MapScale, read_scale
from wheretolook.mapping.imported_map import are_turned, triangulate_at_poses
from wheretolook.mapping.map import extractor_of, find_photographs, find_source, has_image, reads_upright
from wheretolook.mapping.map_folder import DATABASE_FILE, MapRun, SavedReport, color_points, replacing_map
from wheretolook.mapping.map_frame import has_photographs
from wheretolook.mapping.photograph_map import PhotographFeatures, photograph_features, verify_matches
from wheretolook.mapping.photographs import PhotographCameras, list_photographs, photograph_cameras
from wheretolook.mapping.triangulation import fill_database, match_pairs, photograph_pairs, write_matches
from wheretolook.utils.errors import ConfigError, MapError
from wheretolook.utils.files import storing_in_database, temporary_folder
from wheretolook.utils.texts import quiet_colmap


@dataclass(frozen=True)
class ExtendedMapReport(SavedReport):
    """What was added to a model; `report.json` next to the extended one."""

    n_photographs: int  # new ones
    n_placed: int
    unplaced: dict[str, str]  # why photographs got no pose, and which images have most verified matches with them
    skipped: list[str]  # photographs that the map has
    n_new_landmarks: int
    n_extended_landmarks: int  # landmarks of the map with more observations than before
    upright: bool  # whether images are photographs turned upright by EXIF; else they are as stored
    scale: MapScale | None  # of the map; None if it is in any unit
    config: dict[str, Any]
    seconds: dict[str, float]


def extend_map(
    extended: str | Path,
    config: PhotographsConfig,
    out_dir: str | Path = "extended",
    database: Path | None = None,
    seed: int = 0,
    workers: int = 1,
    device: str = "cpu",
    progress: bool = True,
) -> ExtendedMapReport:
    """Add the photographs in `config.images` to a model of COLMAP or hloc, or a map or scene of this project.

    Writes a COLMAP model in the frame of that one, with its poses and cameras to the last digit, a database of all
    keypoints and descriptors and of the new matches, and the report. The extractor is that of the map's features, in
    `database` or found near the model; without any, the model's landmarks are triangulated again from its photographs.
    A photograph has the camera of the map of its proportions, unless EXIF data contradict it or `camera_params` are
    given. Raises MapError if the map has neither features nor photographs, a new photograph has the name of another
    one, or none can be placed; ConfigError for invalid settings.
    """
    map_dir, images = Path(extended), config.images
    if images is None:
        raise ConfigError("no folder of photographs was named", fix="Give --images.")
    if not holds_model(map_dir) and holds_model(map_dir / "map"):  # a scene
        map_dir /= "map"
    model = read_model(map_dir)
    names, skipped = _new_names(map_dir, model, images)
    features, photographs = (database, None) if database is not None else find_source(map_dir)
    kind = None
    if features is not None:
        kind, stored = read_features(features, [image.name for _, image in sorted(model.images.items())], model)
    elif photographs is None:
        fix = "Give --database: COLMAP's database.db or hloc's feats-*.h5; or keep the photographs in images/ near it."
        raise MapError("the map has no features to match photographs with", path=map_dir, fix=fix)
    if config.extractor == ExtractorConfig() or kind_of(config.extractor.method) != kind:
        config = replace(config, extractor=extractor_of(map_dir, kind))
    largest = max(max(camera.width, camera.height) for camera in model.cameras.values())
    turned = reads_upright(map_dir)
    out, old = Path(out_dir).resolve(), map_dir.resolve()
    if out == old or out in old.parents:
        raise ConfigError("the extended map would replace the map", path=out_dir, fix="Give another folder.")
    with replacing_map(config, out_dir, seed, workers, device, progress) as (folder, run):
        with temporary_folder(parent=folder) as work, run.clock("extract"):
            if photographs is not None:
                turned = are_turned(model, photographs)
                known = list(registered_names(model).values())
                of_map = photograph_features(photographs, work / "map", run, largest, known, turned)
                model = triangulate_at_poses(model, photographs, of_map, work / DATABASE_FILE, run)
                stored = of_map.stored
            new = photograph_features(images, work, run, min(largest, config.max_side_px or largest), names, turned)
        lengths = {number: point.track.length() for number, point in model.points3D.items()}
        found = photograph_cameras(images, names, new.full_sizes, new.sizes, config)
        fixed = {*model.cameras}
        stored += _add_images(model, new, found)
        if found.given:
            fixed = {*model.cameras}
        added = sorted(model.images)[-len(names) :]
        written = folder / DATABASE_FILE
        with run.clock("match"):
            pairs = photograph_pairs(stored, new.kind, EXHAUSTIVE_UP_TO, config.overlap)
            pairs = pairs[pairs[:, 1] >= len(stored) - len(names)]
            with storing_in_database(written):
                fill_database(written, model, stored, new.kind)
                matches = match_pairs(stored, pairs, folder, run.processes, progress, new.kind)
                write_matches(written, pairs, matches, sorted(model.images))
                verify_matches(written, run)
        with run.clock("register"):
            unplaced = _register(written, model, added, fixed, run)
        if len(unplaced) == len(names):
            fix = "Give photographs of the same place that overlap with those of the map."
            raise MapError(
                "none of the photographs can be placed in the map",
                path=images,
                value=dict([*unplaced.items()][:3]),
                fix=fix,
            )
        color_points(model, dict(zip(added, new.colors, strict=True)))
        model.update_point_3d_errors()
        longer = [point.track.length() > lengths.get(number, np.inf) for number, point in model.points3D.items()]
        report = ExtendedMapReport(
            n_photographs=len(names),
            n_placed=len(names) - len(unplaced),
            unplaced=unplaced,
            skipped=skipped,
            n_new_landmarks=len({*model.points3D} - {*lengths}),
            n_extended_landmarks=sum(longer),
            upright=turned,
            scale=read_scale(map_dir) if has_photographs(map_dir) else MapScale("given"),
            config={**config.report(), "existing": {"model": extended, "database": database}},
            seconds=run.clock.with_total(),
        )
        write_model(model, folder)
        report.save(folder)
    return report


def _new_names(map_dir: Path, model: Any, images: Path) -> tuple[list[str], list[str]]:
    """Return the names of the photographs in a folder that a model does not have, and of those that it has.

    Raises MapError if a photograph is not known to be the one of its name in the model, or none is new.
    """
    known = {image.name for image in model.images.values()}
    names = list_photographs(images, 1)
    skipped = [name for name in names if name in known]
    if len(skipped) == len(names):
        raise MapError(
            "the map has photographs of all these names", path=images, value=len(names), fix="Give new ones."
        )
    originals = find_photographs(map_dir) if skipped else None
    for name in skipped:
        if originals is None or not has_image(originals, name) or not filecmp.cmp(images / name, originals / name):
            fix = "Rename it, or leave it out if it is the same."
            raise MapError("the map has a photograph of this name, not known to be this", path=images / name, fix=fix)
    return [name for name in names if name not in known], skipped


def _add_images(model: Any, new: PhotographFeatures, found: PhotographCameras) -> list[Stored]:
    """Add photographs without poses to a model, and their cameras unless exactly one of it fits.

    Returns keypoints at the size of the cameras.
    """
    known = [*model.cameras.values()]
    cameras = []
    for camera in found.cameras:
        fitting = [one for one in known if not found.given and _fits(one, camera)]
        if len(fitting) == 1:
            (camera,) = fitting
        else:
            camera.camera_id = max(model.cameras) + 1
            model.add_camera_with_trivial_rig(camera)
        cameras.append(camera)
    stored = []
    for name, row, size, (pixels, descriptors) in zip(new.names, found.camera_of, new.sizes, new.stored, strict=True):
        camera = cameras[row]
        stored.append((pixels * np.float32((camera.width, camera.height) / size), descriptors))
        image = pycolmap.Image(name=name, camera_id=camera.camera_id, image_id=max(model.images) + 1)
        model.add_image_with_trivial_frame(image)
    return stored


def _fits(known: Any, camera: Any) -> bool:
    """Test whether a camera has the proportions of a photograph's and the focal length in its EXIF data, if there is one.

    Refined focal lengths differ from those of EXIF data by a few percent, other lenses and zooms by more than 5.
    """
    across, down = known.width / camera.width, known.height / camera.height
    longer = mean_focal_px(known) / mean_focal_px(camera) / across
    return abs(across / down - 1) < 0.01 and (not camera.has_prior_focal_length or abs(longer - 1) < 0.05)


def _register(database: Path, model: Any, added: list[int], fixed: set[int], run: MapRun) -> dict[str, str]:
    """Place images in a model one after the other, the one that sees most landmarks first; the others are fixed.

    Returns the names of those that cannot be placed, and why.
    """
    seed = run.seed % 2**31  # COLMAP keeps it in an int
    options = pycolmap.IncrementalPipelineOptions(random_seed=seed, num_threads=run.processes.workers)
    options.fix_existing_frames = True
    options.constant_cameras = fixed
    options.constant_rigs = {*model.rigs}
    mapping, triangulation = options.get_mapper(), options.get_triangulation()
    local, overall = options.get_local_bundle_adjustment(), options.get_global_bundle_adjustment()
    with quiet_colmap("ERROR"), pycolmap.Database.open(str(database)) as db:
        pycolmap.set_random_seed(seed)
        cache = pycolmap.DatabaseCacheOptions(min_num_matches=options.min_num_matches, load_all_images=True)
        mapper = pycolmap.IncrementalMapper(pycolmap.DatabaseCache.create(db, cache))
        mapper.begin_reconstruction(model)
        poses = {number: deepcopy(frame.rig_from_world) for number, frame in model.frames.items() if frame.has_pose()}
        while candidates := mapper.find_next_images(mapping, False):
            for number in candidates:
                if mapper.register_next_image(mapping, number):
                    mapper.triangulate_image(triangulation, number)
                    mapper.iterative_local_refinement(2, 1e-3, mapping, local, triangulation, number)  # as COLMAP does
                    break
        mapper.iterative_global_refinement(5, 5e-4, mapping, overall, triangulation, False)
        unplaced = {}
        for number in added:
            image = model.images[number]
            if image.has_pose:
                continue
            partners = []
            for other in model.images.values():
                if db.exists_two_view_geometry(number, other.image_id):
                    n = len(db.read_two_view_geometry(number, other.image_id).inlier_matches)
                    partners.append((n, f"{n} with {other.name}" + " (not placed)" * (not other.has_pose)))
            best = ", ".join(text for n, text in sorted(partners, reverse=True)[:3] if n) or "none"
            seen = mapper.observation_manager.num_visible_points3D(number)
            needed = f"{seen} matches with landmarks, {mapping.abs_pose_min_num_inliers} that agree are needed"
            unplaced[image.name] = f"{needed}; verified matches: {best}"
        mapper.end_reconstruction(False)  # removes what has no pose from the model
    for number, pose in poses.items():
        model.frames[number].rig_from_world = pose  # which is normalized by adjustments
    return unplaced
