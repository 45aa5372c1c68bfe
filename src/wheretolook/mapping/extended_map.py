"""Add photographs to an existing model, whose poses and cameras stay as they are."""

from __future__ import annotations

import filecmp
import json
from collections.abc import Iterable
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.features.extractor import DescriptorKind, ExtractorConfig, Stored, kind_of
from wheretolook.geometry.camera import mean_focal_px
from wheretolook.geometry.similarity import local_origin
from wheretolook.mapping.colmap_model import describe_cameras, holds_model, read_model, write_model
from wheretolook.mapping.config import EXHAUSTIVE_UP_TO, PhotographsConfig
from wheretolook.mapping.feature_files import features_kind, read_features
from wheretolook.mapping.georeference import REPORT_FILE, MapScale, read_scale
from wheretolook.mapping.imported_map import are_turned, triangulate_at_poses
from wheretolook.mapping.map import extractor_of, find_photographs, find_source, has_image, reads_upright
from wheretolook.mapping.map_folder import DATABASE_FILE, MapRun, replacing_map
from wheretolook.mapping.map_frame import has_photographs
from wheretolook.mapping.photograph_map import PhotographFeatures, photograph_features, verify_matches
from wheretolook.mapping.photographs import list_photographs, photograph_cameras
from wheretolook.mapping.triangulation import fill_database, match_pairs, photograph_pairs
from wheretolook.utils.errors import ConfigError, MapError
from wheretolook.utils.files import storing_in_database, temporary_folder, write_text
from wheretolook.utils.texts import quiet_colmap


@dataclass(frozen=True)
class UnplacedPhotograph:
    """A photograph that got no pose, and why."""

    name: str
    reason: str
    matches: dict[str, int]  # verified matches with images of the extended map, at most three
    would_help: dict[str, int]  # verified matches with other photographs without a pose: placing these may place it

    def describe(self) -> str:
        """State the photograph and the reason in one clause."""
        matches = ", ".join(f"{name} {n}" for name, n in self.matches.items())
        others = ", ".join(f"{name} {n}" for name, n in self.would_help.items())
        verified = f"; verified matches with images of the map: {matches or 'none'}"
        return f"{self.name}: {self.reason}{verified}" + (f"; others that would help: {others}" if others else "")


@dataclass(frozen=True)
class ExtendedMapReport:
    """What was added to a model; `report.json` next to the extended one."""

    n_photographs: int  # new ones
    n_placed: int
    unplaced: list[UnplacedPhotograph]
    skipped: list[str]  # photographs that the map has
    n_new_landmarks: int
    n_extended_landmarks: int  # landmarks of the map with more observations than before
    new_cameras: list[dict[str, Any]]  # of photographs that no camera of the map fits
    upright: bool  # whether images are photographs turned upright by EXIF; else they are as stored
    scale: MapScale | None  # of the map; None if it is in any unit
    seed: int
    config: dict[str, Any]
    seconds: dict[str, float]

    def save(self, folder: Path) -> None:
        """Write the report into the folder of the model."""
        record = asdict(self)
        if self.scale is None:
            del record["scale"]
        write_text(folder / REPORT_FILE, json.dumps(record, indent=2, default=str) + "\n")


def extend_map(
    map_dir: str | Path,
    config: PhotographsConfig,
    out_dir: str | Path = "extended",
    database: Path | None = None,
    seed: int = 0,
    workers: int = 1,
    device: str = "cpu",
    progress: bool = True,
) -> ExtendedMapReport:
    """Add the photographs in `config.images` to the model in `map_dir`, of COLMAP, hloc or this project.

    Writes a COLMAP model in the frame of that one, with its poses and cameras to the last digit, a database of all
    keypoints and descriptors and of the new matches, and the report. The extractor is that of the map's features, in
    `database` or found near the model; without any, the model's landmarks are triangulated again from its photographs.
    A photograph has the camera of the map of its proportions, unless EXIF data contradict it or `camera_params` are
    given. Raises MapError if the map has neither features nor photographs, a new photograph has the name of another
    one, or none can be placed; ConfigError for invalid settings.
    """
    map_dir, images = Path(map_dir), config.images
    if images is None:
        raise ConfigError("no folder of photographs was named", fix="Give --images.")
    if not holds_model(map_dir) and holds_model(map_dir / "map"):  # a scene
        map_dir = map_dir / "map"
    model = read_model(map_dir)
    names, skipped = _new_names(map_dir, model, images)
    turned = reads_upright(map_dir)
    features, photographs = (database, None) if database is not None else find_source(map_dir)
    kind = None if features is None else features_kind(features, model)
    if kind is None and photographs is None:
        fix = "Give --database: COLMAP's database.db or hloc's feats-*.h5; or keep the photographs in images/ near it."
        raise MapError("the map has no features that photographs could be matched with", path=map_dir, fix=fix)
    if config.extractor == ExtractorConfig():
        config = replace(config, extractor=extractor_of(map_dir, "" if kind is None else kind.name))
    if kind is not None and kind_of(config.extractor.method) != kind:
        fix = "Leave --extractor out."
        raise ConfigError(f"the map has features of {kind.name}", value=config.extractor.method, fix=fix)
    with replacing_map(config, out_dir, seed, workers, device, progress) as (folder, run):
        with temporary_folder(parent=folder) as work, run.clock("extract"):
            largest = max(max(camera.width, camera.height) for camera in model.cameras.values())
            if features is not None:
                kind, stored = read_features(features, [image.name for _, image in sorted(model.images.items())])
            else:
                assert photographs is not None
                turned = are_turned(model, photographs)
                known = [image.name for _, image in sorted(model.images.items()) if image.has_pose]
                of_map = photograph_features(photographs, work / "map", run, largest, known, turned)
                model = triangulate_at_poses(model, photographs, of_map, work / DATABASE_FILE, run)
                kind, stored = of_map.kind, of_map.stored
            side = min(largest, config.max_side_px or largest)
            new = photograph_features(images, work, run, side, names, turned)
        stored = _of_model(model, stored)
        extension = _Extension(model, new, folder / DATABASE_FILE, run)
        extension.add_images(images, config)
        with run.clock("match"):
            extension.match([*stored, *extension.stored], kind)
        with run.clock("register"):
            unplaced = extension.register()
        n_placed = len(names) - len(unplaced)
        if n_placed == 0:
            best = max(unplaced, key=lambda one: max([0, *one.matches.values()]))
            fix = "Give photographs of the same place that overlap with those of the map."
            raise MapError(
                "none of the photographs can be placed in the map", path=images, value=best.describe(), fix=fix
            )
        is_rendered = not has_photographs(map_dir)
        report = ExtendedMapReport(
            n_photographs=len(names),
            n_placed=n_placed,
            unplaced=unplaced,
            skipped=skipped,
            **extension.finish(config.max_reprojection_error_px),
            upright=turned,
            scale=MapScale("given") if is_rendered else read_scale(map_dir),
            seed=seed,
            config={**config.report(), "existing": {"model": map_dir, "database": database}},
            seconds=run.clock.with_total(),
        )
        write_model(model, folder)
        report.save(folder)
    return report


def _new_names(map_dir: Path, model: Any, images: Path) -> tuple[list[str], list[str]]:
    """Return the names of the photographs in a folder that a model does not have, and of those that it has.

    Raises MapError if another photograph has the name of one in the model, or none is new.
    """
    names = list_photographs(images, 1)
    known = {image.name for image in model.images.values()}
    skipped = [name for name in names if name in known]
    originals = find_photographs(map_dir) if skipped else None
    for name in skipped:
        if originals is None or not has_image(originals, name):
            problem = "the map has a photograph of this name, whose file is not found for comparison"
            raise MapError(problem, path=images / name, fix="Rename it if it is another one; otherwise leave it out.")
        if not filecmp.cmp(images / name, originals / name, shallow=False):
            raise MapError("the map has another photograph of this name", path=images / name, fix="Rename it.")
    new = [name for name in names if name not in known]
    if not new:
        raise MapError("the map has all of these photographs", path=images, value=len(names), fix="Give new ones.")
    return new, skipped


def _of_model(model: Any, stored: Iterable[Stored]) -> list[Stored]:
    """Return keypoints as the images of a model have them, in the order of ids, with descriptors from files.

    Sets the keypoints of images that have none in the model, since they observe nothing.
    """
    result = []
    for (_, image), (pixels, descriptors) in zip(sorted(model.images.items()), stored, strict=True):
        if image.num_points2D() == 0:
            image.points2D = _keypoints(pixels)
        elif image.num_points2D() != len(pixels):
            value = (len(pixels), image.num_points2D())
            fix = "Give the features that the model was built from: --database."
            raise MapError(
                f"features and model disagree on the number of keypoints of {image.name}", value=value, fix=fix
            )
        result.append((np.array([point.xy for point in image.points2D]).reshape(-1, 2), descriptors))
    return result


def _keypoints(pixels: NDArray[Any]) -> Any:
    return pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels.astype(np.float64)])


class _Extension:
    """A model that photographs are added to."""

    def __init__(self, model: Any, new: PhotographFeatures, database: Path, run: MapRun) -> None:
        self.model = model
        self.new = new
        self.database = database
        self.run = run
        poses = {number: frame for number, frame in model.frames.items() if frame.has_pose()}
        self.old_poses = {number: deepcopy(frame.rig_from_world) for number, frame in poses.items()}
        self.old_cameras = [*model.cameras]
        self.old_images = sorted(model.images)
        self.observations = {number: point.track.length() for number, point in model.points3D.items()}
        self.ids: list[int] = []  # of the new photographs
        self.stored: list[Stored] = []  # their keypoints, at the size of their cameras

    def add_images(self, images: Path, config: PhotographsConfig) -> None:
        """Add the photographs without poses, and cameras for those that none of the map fits."""
        new, model = self.new, self.model
        found = photograph_cameras(images, new.names, new.full_sizes, new.sizes, config)
        cameras = []
        for camera in found.cameras:
            fitting = None if found.given else self._camera_of_map(camera)
            if fitting is None:
                camera.camera_id = max(model.cameras) + 1
                model.add_camera_with_trivial_rig(camera)
            cameras.append(fitting or camera)
        for name, row, size, (pixels, descriptors) in zip(
            new.names, found.camera_of.tolist(), new.sizes.tolist(), new.stored, strict=True
        ):
            camera = cameras[row]
            pixels = pixels * (np.array([camera.width, camera.height]) / size).astype(np.float32)
            self.ids.append(max(model.images) + 1)
            image = pycolmap.Image(name=name, camera_id=camera.camera_id, image_id=self.ids[-1])
            image.points2D = _keypoints(pixels)
            model.add_image_with_trivial_frame(image)
            self.stored.append((pixels, descriptors))
        self.refined = set() if found.given else {*model.cameras} - {*self.old_cameras}

    def _camera_of_map(self, camera: Any) -> Any:
        """Return the map's camera of the proportions of a photograph's, with the focal length of its EXIF data.

        Without EXIF data it is the only one of these proportions. None if there is none such.
        """
        ratio = camera.width / camera.height
        known = [self.model.cameras[number] for number in self.old_cameras]
        known = [one for one in known if 0.99 <= one.width / (one.height * ratio) <= 1.01]
        if not camera.has_prior_focal_length:
            return known[0] if len(known) == 1 else None

        def off(one: Any) -> float:
            return abs(float(np.log(mean_focal_px(one) / one.width * camera.width / mean_focal_px(camera))))

        best = min(known, key=off, default=None)
        # 5 %: refined focal lengths differ from those of EXIF data by a few, other lenses and zooms by more
        return best if best is not None and off(best) < 0.05 else None

    def match(self, stored: list[Stored], kind: DescriptorKind) -> None:
        """Match each new photograph with those of the map and the others, verify, and write the database."""
        pairs = photograph_pairs(stored, kind, EXHAUSTIVE_UP_TO, PhotographsConfig.overlap)
        pairs = pairs[pairs[:, 1] >= len(self.old_images)]
        ids = np.array([*self.old_images, *self.ids])[pairs].tolist()
        run = self.run
        with storing_in_database(self.database):
            fill_database(self.database, self.model, stored, kind)
            matched = match_pairs(stored, pairs, self.database.parent, run.processes, run.progress, kind)
            with pycolmap.Database.open(str(self.database)) as db:
                for (first, second), matches in zip(ids, matched, strict=True):
                    db.write_matches(first, second, matches)
            verify_matches(self.database, run)

    def register(self) -> list[UnplacedPhotograph]:
        """Place photographs one after the other, the one that sees most landmarks first; return those left."""
        model, run = self.model, self.run
        origin = local_origin([image.projection_center() for image in model.images.values() if image.has_pose])
        to_local = pycolmap.Sim3d(1.0, pycolmap.Rotation3d(np.eye(3)), -origin)
        model.transform(to_local)
        seed = run.seed % 2**31  # COLMAP keeps it in an int
        options = pycolmap.IncrementalPipelineOptions(random_seed=seed, num_threads=run.processes.workers)
        options.fix_existing_frames = True
        options.constant_cameras = {*model.cameras} - self.refined
        options.constant_rigs = {*model.rigs}
        # the graph of matches lacks those within the map, without which most observations seem to be of two views
        options.triangulation.ignore_two_view_tracks = False
        mapping, triangulation = options.get_mapper(), options.get_triangulation()
        refinement = (options.ba_local_max_refinements, options.ba_local_max_refinement_change, mapping)
        bar = tqdm(total=len(self.ids), desc="map: register", disable=not run.progress, unit="image")
        with quiet_colmap("ERROR"), bar, pycolmap.Database.open(str(self.database)) as db:
            pycolmap.set_random_seed(seed)
            mapper = pycolmap.IncrementalMapper(
                pycolmap.DatabaseCache.create(db, pycolmap.DatabaseCacheOptions(min_num_matches=15))
            )
            mapper.begin_reconstruction(model)
            while placed := self._place_next(mapper, mapping):
                mapper.triangulate_image(triangulation, placed)
                adjustment = options.get_local_bundle_adjustment()
                mapper.iterative_local_refinement(*refinement, adjustment, triangulation, placed)
                bar.update()
            mapper.complete_and_merge_tracks(triangulation)
            for _ in range(2):
                self._adjust(options)
                seen = {number for number in model.points3D if number not in self.observations}
                limits = (mapping.filter_max_reproj_error, mapping.filter_min_tri_angle)
                mapper.observation_manager.filter_points3D(*limits, seen)
            unplaced = self._unplaced(mapper, db, mapping.abs_pose_min_num_inliers)
            mapper.end_reconstruction(False)
        model.transform(to_local.inverse())
        for number, pose in self.old_poses.items():
            model.frames[number].rig_from_world = pose
        return unplaced

    def _place_next(self, mapper: Any, options: Any) -> int:
        """Place the photograph that sees most landmarks, or the next one that can be. Returns its id, 0 for none."""
        for number in mapper.find_next_images(options, False):
            if mapper.register_next_image(options, number):
                return int(number)
        return 0

    def _adjust(self, options: Any) -> None:
        """Adjust the poses of the placed photographs, their new cameras, and the landmarks that they observe."""
        config = pycolmap.BundleAdjustmentConfig()
        for number in self.ids:
            image = self.model.images[number]
            if image.has_pose:
                config.add_image(number)
                for row in image.get_observation_point2D_idxs():
                    config.add_variable_point(image.points2D[row].point3D_id)
        for number in options.constant_cameras:
            config.set_constant_cam_intrinsics(number)
        pycolmap.create_default_bundle_adjuster(options.get_global_bundle_adjustment(), config, self.model).solve()

    def _unplaced(self, mapper: Any, db: Any, needed: int) -> list[UnplacedPhotograph]:
        """Describe the photographs without a pose, given how many landmarks one needs to match."""
        images = self.model.images
        verified: dict[int, list[tuple[int, int]]] = {number: [] for number in images}
        for pair, number in zip(*db.read_two_view_geometry_num_inliers(), strict=True):
            first, second = pycolmap.pair_id_to_image_pair(pair)
            verified[first].append((number, second))
            verified[second].append((number, first))
        unplaced = []
        for number in self.ids:
            if images[number].has_pose:
                continue
            n_landmarks = mapper.observation_manager.num_visible_points3D(number)
            reason = f"{n_landmarks} matches with landmarks, which agree on no pose"
            if n_landmarks < needed:
                reason = f"{n_landmarks} matches with landmarks, of {needed} needed"
            best = [(images[other], n) for n, other in sorted(verified[number], reverse=True) if n > 0]
            placed = {image.name: n for image, n in best if image.has_pose}
            others = {image.name: n for image, n in best if not image.has_pose}
            three = [dict([*found.items()][:3]) for found in (placed, others)]
            unplaced.append(UnplacedPhotograph(images[number].name, reason, *three))
        return unplaced

    def finish(self, max_error_px: float) -> dict[str, Any]:
        """Filter and colour the new landmarks. Returns fields of the report."""
        model = self.model
        model.update_point_3d_errors()
        colors = dict(zip(self.ids, self.new.colors, strict=True))
        for number in [*model.points3D]:
            point = model.points3D[number]
            if number in self.observations:
                continue
            if point.track.length() < 3 or point.error > max_error_px:  # COLMAP's mapper ignores tracks of two
                model.delete_point3D(number)
                continue
            track = [one for one in point.track.elements if one.image_id in colors]
            observed = [colors[one.image_id][one.point2D_idx] for one in track]
            if observed:
                point.color = np.rint(np.mean(observed, axis=0)).astype(np.uint8)
        lengths = {number: point.track.length() for number, point in model.points3D.items()}
        return {
            "n_new_landmarks": len(lengths.keys() - self.observations.keys()),
            "n_extended_landmarks": sum(lengths.get(number, 0) > n for number, n in self.observations.items()),
            "new_cameras": describe_cameras(model)[len(self.old_cameras) :],
        }
