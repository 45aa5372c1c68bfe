"""Map photographs by structure from motion."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from tqdm.auto import tqdm

from wheretolook.features.extractor import DescriptorKind, Stored, kind_of
from wheretolook.geometry.poses import camera_centers
from wheretolook.geometry.similarity import Similarity
from wheretolook.mapping.colmap_model import colmap_poses, describe_cameras, read_model, registered_names, write_model
from wheretolook.mapping.config import EXHAUSTIVE_UP_TO, PhotographsConfig
from wheretolook.mapping.georeference import MapScale, MarkedPhotographs, check_tables
from wheretolook.mapping.map_folder import MapDraft, MapReport, MapRun, finish_map, replacing_map
from wheretolook.mapping.map_frame import IDENTITY, estimate_gravity, find_frame
from wheretolook.mapping.photographs import (
    PhotographCameras,
    list_photographs,
    photograph_cameras,
    read_photograph,
    reduce_photograph,
)
from wheretolook.mapping.triangulation import (
    extract_with_colors,
    fill_database,
    match_pairs,
    photograph_pairs,
    write_matches,
)
from wheretolook.utils.errors import ConfigError, MapError
from wheretolook.utils.files import ArtifactCache, cache_key, storing_in_database, temporary_folder
from wheretolook.utils.texts import quiet_colmap

_MIN_IMAGES = 3  # of a model: two photographs do not determine a camera
_MIN_INLIERS = 30  # as COLMAP needs to place a photograph


@dataclass(frozen=True, eq=False)
class PhotographFeatures:
    """Keypoints of photographs."""

    names: list[str]  # of the I photographs, relative to their folder
    full_sizes: NDArray[np.int64]  # (I, 2) width and height as taken, upright
    sizes: NDArray[np.int64]  # (I, 2) width and height as mapped
    stored: list[Stored]  # pixels and descriptors of each photograph's keypoints
    colors: list[NDArray[np.uint8]]  # (N_i, 3) uint8 of each photograph's keypoints
    key: str  # hash of everything that determines the keypoints
    kind: DescriptorKind  # of the descriptors


@dataclass(frozen=True, eq=False)
class MappedPhotographs:
    """The result of mapping."""

    model: Any  # the largest `pycolmap.Reconstruction`, in a frame and scale of its own; photograph i has the id i + 1
    database: Path  # COLMAP's database of keypoints and verified matches
    model_sizes: list[int]  # photographs in each model, the largest first
    mappers: dict[str, int]  # photographs in the largest model of each mapper that was tried


def photograph_features(
    folder: Path, work: Path, run: MapRun, max_side_px: int, names: list[str] | None = None, turned: bool = True
) -> PhotographFeatures:
    """Extract keypoints of photographs in a folder, at most `max_side_px` large; those of a finished run are reused.

    Takes all photographs unless names are given; `turned` is that of `read_photograph`. Raises MapError if one cannot
    be read, or the folder holds fewer than two.
    """
    names = list_photographs(folder) if names is None else names
    extractor = run.config.extractor
    stats = [(folder / name).stat() for name in names]
    files = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in zip(names, stats, strict=True)]
    version = 2  # of the format of finished steps
    key = cache_key(version, files, max_side_px, extractor.record(), turned)
    arrays = _cached_arrays(work, key, "features", lambda: _extract(folder, names, turned, max_side_px, run))
    ends = np.cumsum(arrays["counts"])[:-1]
    pixels, descriptors, colors = (np.split(arrays[name], ends) for name in ("pixels", "descriptors", "colors"))
    stored = list(zip(pixels, descriptors, strict=True))
    kind = kind_of(extractor.method)
    return PhotographFeatures(names, arrays["full_sizes"], arrays["sizes"], stored, colors, key, kind)


def match_and_map(
    work: Path, features: PhotographFeatures, cameras: PhotographCameras, overlap: int, run: MapRun
) -> MappedPhotographs:
    """Match photographs, verify the matches, and map incrementally (Schonberger and Frahm, CVPR 2016) or globally.

    Finished steps are cached in `work`. The worker processes match; COLMAP's bundle adjustment takes as many threads.
    Raises MapError if the photographs do not overlap enough for a map.
    """
    seed = run.seed % 2**31  # COLMAP keeps it in an int
    key = cache_key(features.key, EXHAUSTIVE_UP_TO, overlap)
    database = work / "database.db"

    def match() -> dict[str, NDArray[Any]]:
        pairs = photograph_pairs(features.stored, features.kind, EXHAUSTIVE_UP_TO, overlap)
        with storing_in_database(database):
            matches = list(match_pairs(features.stored, pairs, work, run.processes, run.progress, features.kind))
        return {"pairs": pairs, "matches": np.concatenate(matches), "counts": np.array([*map(len, matches)])}

    arrays = _cached_arrays(work, key, "matches", match)
    matches = np.split(arrays["matches"], np.cumsum(arrays["counts"])[:-1])
    intrinsics = [camera.todict() for camera in cameras.cameras]
    version = 2  # of the results
    key = cache_key(version, key, intrinsics, cameras.camera_of.tolist(), cameras.given, seed)
    folder = work / "sparse"
    cache = ArtifactCache(work, key, "sparse", "steps.json")
    results = cache.load("sparse.json") if cache.is_current(database, folder) else None
    if results is None:
        cache.clear()
        database.unlink(missing_ok=True)
        shutil.rmtree(folder, ignore_errors=True)
        with storing_in_database(database):
            model = _unposed_model(features, cameras)
            fill_database(database, model, features.stored, features.kind)
            write_matches(database, arrays["pairs"], matches, sorted(model.images))
            results = cache.store({"sparse.json": _reconstruct(database, folder, cameras, seed, run)})
    return MappedPhotographs(read_model(folder), database, **results["sparse.json"])


def _cached_arrays(
    work: Path, key: str, step: str, compute: Callable[[], dict[str, NDArray[Any]]]
) -> dict[str, NDArray[Any]]:
    """Arrays of a step of work, read from its file or computed and written there."""
    cache = ArtifactCache(work, key, step, "steps.json")
    name = f"{step}.npz"
    return (cache.load(name) or cache.store({name: compute()}))[name]


def _extract(folder: Path, names: list[str], turned: bool, max_side_px: int, run: MapRun) -> dict[str, NDArray[Any]]:
    """Sizes, keypoints, descriptors and colours of photographs, as the arrays of `features.npz`."""
    sizes = []

    def images() -> Iterator[NDArray[np.uint8]]:
        for name in names:
            rgb = read_photograph(folder / name, turned)
            reduced = reduce_photograph(rgb, max_side_px)
            sizes.append((rgb.shape[1::-1], reduced.shape[1::-1]))
            yield reduced

    extracted = extract_with_colors(images(), len(names), "map: extract", run, same_size=False)
    rows = [(len(color), pixels, descriptors, color) for (pixels, descriptors), color in extracted]
    counts, pixels, descriptors, colors = zip(*rows, strict=True)
    full_sizes, reduced_sizes = np.swapaxes(sizes, 0, 1)
    return {
        "full_sizes": full_sizes,
        "sizes": reduced_sizes,
        "counts": np.array(counts),
        "pixels": np.concatenate(pixels),
        "descriptors": np.concatenate(descriptors),
        "colors": np.concatenate(colors),
    }


def _unposed_model(features: PhotographFeatures, cameras: PhotographCameras) -> Any:
    """Make a reconstruction of photographs and their cameras, without poses."""
    model = pycolmap.Reconstruction()
    for camera in cameras.cameras:
        model.add_camera_with_trivial_rig(camera)
    for index, (name, row) in enumerate(zip(features.names, cameras.camera_of.tolist(), strict=True)):
        image = pycolmap.Image(name=name, camera_id=cameras.cameras[row].camera_id, image_id=index + 1)
        model.add_image_with_trivial_frame(image)
    return model


def _reconstruct(database: Path, folder: Path, cameras: PhotographCameras, seed: int, run: MapRun) -> dict[str, Any]:
    """Verify matches, map, and write the largest model. Returns `model_sizes` and `mappers` of `MappedPhotographs`.

    The next mapper is tried while the largest model has fewer than half of the photographs that verified matches
    connect. Raises MapError if none of them gives a model.
    """
    verify_matches(database, run)
    enough = _connected(database, len(cameras.camera_of)) / 2
    attempts: dict[str, Callable[[Path], dict[int, Any]]] = {
        "incremental": lambda models: _map_incrementally(database, models, cameras, seed, run),
        "incremental for forward motion": lambda models: _map_incrementally(database, models, cameras, seed, run, True),
        "global": lambda models: _map_globally(database, models, cameras, seed, run),
    }
    best: list[Any] = []
    mappers: dict[str, int] = {}
    for name, attempt in attempts.items():
        with temporary_folder(".partial", parent=folder.parent) as models, quiet_colmap("ERROR"):
            pycolmap.set_random_seed(seed)
            mapped = attempt(models).values()
        found = sorted(mapped, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
        mappers[name] = found[0].num_reg_images() if found else 0
        if mappers[name] > max([0, *(model.num_reg_images() for model in best)]):
            best = found
        if mappers[name] >= enough:
            break
    if not best:
        fix = f"Give at least {_MIN_IMAGES} sharp photographs from different places, each of which overlaps the next;"
        fix += " a focal length (mapping.photographs.camera_params) helps."
        problem = f"the photographs do not overlap enough for a map (tried: {', '.join(mappers)})"
        raise MapError(problem, path=database, fix=fix)
    write_model(best[0], folder)
    return {"model_sizes": [model.num_reg_images() for model in best], "mappers": mappers}


def verify_matches(database: Path, run: MapRun) -> None:
    """Verify the matches in a COLMAP database by two-view geometry."""
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = run.seed % 2**31  # COLMAP keeps it in an int
    with quiet_colmap("ERROR"):
        verifier = pycolmap.GeometricVerifierOptions(num_threads=run.processes.workers)
        pycolmap.geometric_verification(str(database), verifier, two_view_geometry_options=verification)


def _connected(database: Path, n: int) -> int:
    """Return how many of n photographs are connected by pairs with enough verified matches to place one by another."""
    with pycolmap.Database.open(str(database)) as db:
        pair_ids, n_inliers = db.read_two_view_geometry_num_inliers()
    verified = [pair for pair, number in zip(pair_ids, n_inliers, strict=True) if number >= _MIN_INLIERS]
    pairs = [pycolmap.pair_id_to_image_pair(pair) for pair in verified]
    rows, columns = np.array(pairs, dtype=np.int64).reshape(-1, 2).T - 1
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    return int(np.bincount(connected_components(graph, directed=False)[1]).max())


def _map_incrementally(
    database: Path, models: Path, cameras: PhotographCameras, seed: int, run: MapRun, forward: bool = False
) -> dict[int, Any]:
    """Map with COLMAP's incremental mapper; `forward` also starts from pairs along the viewing direction."""
    threads = run.processes.workers
    options = pycolmap.IncrementalPipelineOptions(random_seed=seed, num_threads=threads, extract_colors=False)
    options.min_model_size = _MIN_IMAGES
    options.ba_refine_focal_length = options.ba_refine_extra_params = not cameras.given
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = not cameras.given
    options.triangulation.random_seed = options.mapper.random_seed = seed
    options.mapper.num_threads = threads
    if forward:
        options.mapper.init_max_forward_motion = 1.0
        options.mapper.init_min_tri_angle = 4.0
    bar = tqdm(total=len(cameras.camera_of), desc="map: register", disable=not run.progress, unit="image")

    def start_model() -> None:
        bar.reset()  # a photograph may be in several models
        bar.update(2)

    steps: Any = {"initial_image_pair_callback": start_model, "next_image_callback": lambda: bar.update(1)}
    with bar:
        return dict(pycolmap.incremental_mapping(str(database), str(models), str(models), options, **steps))


def _map_globally(database: Path, models: Path, cameras: PhotographCameras, seed: int, run: MapRun) -> dict[int, Any]:
    """Map with COLMAP's global mapper (Pan et al., ECCV 2024); photographs that observe few points lose their pose."""
    threads = run.processes.workers
    options = pycolmap.GlobalPipelineOptions(random_seed=seed, num_threads=threads, min_model_size=_MIN_IMAGES)
    adjustment = options.mapper.bundle_adjustment
    adjustment.refine_focal_length = adjustment.refine_extra_params = not cameras.given
    try:
        mapped = dict(pycolmap.global_mapping(str(database), str(models), str(models), options))
    except (RuntimeError, ValueError):  # too few pairs
        return {}
    for model in mapped.values():
        for image in list(model.images.values()):
            if image.has_pose and image.num_points3D < _MIN_INLIERS:
                model.deregister_frame(image.frame_id)
    return {number: model for number, model in mapped.items() if model.num_reg_images() >= _MIN_IMAGES}


@dataclass(frozen=True)
class PhotographMapReport(MapReport):
    """Properties of a map from photographs; `report.json`."""

    n_registered: int  # photographs that have a pose
    unregistered: list[str]  # names of the others
    model_sizes: list[int]  # photographs in each model that did not connect with another; the first is the map
    mappers: dict[str, int]  # photographs that each mapper placed; the next was tried where these were few
    n_keypoints: int  # keypoints of all photographs
    cameras: list[dict[str, Any]]  # COLMAP's intrinsics of the reduced photographs
    n_known_focal: int  # cameras that started from a focal length that was given or is in the EXIF data
    gravity: dict[str, Any]  # "method" ("positions" or that of `Gravity`), "median_deg" and "max_deg" of its residuals
    scale: MapScale


def map_photographs(
    config: PhotographsConfig,
    out_dir: str | Path = "map",
    work: Path = Path("photographs"),
    seed: int = 0,
    workers: int = 1,
    device: str = "cpu",
    progress: bool = True,
    before_replace: Callable[[], None] = lambda: None,
) -> PhotographMapReport:
    """Map the photographs in `config.images`.

    Writes what `build_map` writes, z up, and in metres if the report's scale has a source. Unless positions are given,
    the origin is the mean of the cameras' positions and the heading is arbitrary. Finished steps are cached in `work`.
    With one worker the same seed gives the same map; with more, COLMAP's bundle adjustment sums in any order. Raises
    MapError if photographs are unreadable, do not overlap or do not give the scale; ConfigError for invalid settings.
    """
    images = config.images
    if images is None:
        raise ConfigError("no folder of photographs was named", fix="Give --images.")
    check_tables(config.scale, config.frame)  # before the work
    with replacing_map(config, out_dir, seed, workers, device, progress, before_replace) as (folder, run):
        with run.clock("extract"):
            features = photograph_features(images, work, run, config.max_side_px)
        with run.clock("map"):
            cameras = photograph_cameras(images, features.names, features.full_sizes, features.sizes, config)
            mapped = match_and_map(work, features, cameras, config.overlap, run)
        model = mapped.model
        with run.clock("gravity"):
            poses = colmap_poses(work, model)
            gravity = estimate_gravity(poses, config.up_in_camera)
            center = camera_centers(poses).mean(0)
            Similarity(1.0, gravity.rotation, -gravity.rotation @ center).transform_model(model)
        with run.clock("scale"):
            photographs = MarkedPhotographs(config.scale, images, progress=progress)
            options = config.frame if config.frame.positions else replace(config.frame, up="z")
            frame = find_frame(work, model, options, photographs=photographs)
            frame.world_from_map.transform_model(model)
            model.update_point_3d_errors()
        out_dir = Path(out_dir)
        fix = "Raise `PhotographsConfig.max_reprojection_error_px`, or take sharper photographs."
        draft = MapDraft(model, out_dir, config.max_reprojection_error_px, fix, mapped.database, features.colors)
        landmarks, fields = finish_map(draft, folder, run)
        registered = set(registered_names(model).values())
        report = PhotographMapReport(
            n_images=len(features.names),
            **fields,
            seconds=run.clock.with_total(),
            n_registered=len(registered),
            unregistered=[name for name in features.names if name not in registered],
            model_sizes=mapped.model_sizes,
            mappers=mapped.mappers,
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
