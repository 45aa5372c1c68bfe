"""Poses and points of photographs by COLMAP's incremental mapping. Finished steps are kept and not done again."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.features.config import ExtractorConfig
from wheretolook.features.descriptors import DescriptorKind, Stored
from wheretolook.features.extraction import KeypointExtractor
from wheretolook.features.registry import kind_of
from wheretolook.mapping import photographs
from wheretolook.mapping.colmap_model import read_model, write_model
from wheretolook.mapping.photographs import PhotographCameras, list_photographs, photograph_pairs
from wheretolook.mapping.rendered_map import extract_with_colors
from wheretolook.mapping.triangulation import fill_database, match_pairs, stored_keypoints
from wheretolook.utils.colmap import quiet_colmap, storing_in_database
from wheretolook.utils.errors import MapError
from wheretolook.utils.files import write_json
from wheretolook.utils.npz_files import load_npz, save_npz
from wheretolook.utils.processes import WorkerPool
from wheretolook.utils.reading import read_json_object

_LEAST_IMAGES = 3  # of a model: two photographs alone do not determine a camera
_VERSION = 1  # of the format in which finished steps are kept


@dataclass(frozen=True, eq=False)
class PhotographFeatures:
    """Keypoints of photographs."""

    names: list[str]  # of the I photographs, relative to their folder
    full_sizes: NDArray[np.int64]  # (I, 2) width and height as taken, upright
    sizes: NDArray[np.int64]  # (I, 2) width and height as mapped
    stored: list[Stored]  # pixels and descriptors of each photograph's keypoints
    colors: list[NDArray[np.uint8]]  # (N_i, 3) uint8 of each photograph's keypoints
    key: str  # changes whenever something changes that the keypoints depend on
    kind: DescriptorKind  # of the descriptors


@dataclass(frozen=True, eq=False)
class MappedPhotographs:
    """The result of incremental mapping."""

    model: Any  # the largest `pycolmap.Reconstruction`, in a frame and scale of its own; photograph i has the id i + 1
    database: Path  # COLMAP's database of keypoints and verified matches
    model_sizes: list[int]  # photographs in each model, the largest first


def photograph_features(
    folder: Path,
    work: Path,
    max_side_px: int,
    extractor: ExtractorConfig,
    processes: WorkerPool,
    device: str = "cpu",
    progress: bool = True,
    names: list[str] | None = None,
    turned: bool = True,
) -> PhotographFeatures:
    """Keypoints of photographs in a folder, by the project's extractor: a later localization uses the same.

    Of all photographs in it, unless names are given; read as `read_photograph` does. Raises MapError if one cannot be
    read, or the folder holds fewer than two.
    """
    names = list_photographs(folder) if names is None else names
    files = [(name, (folder / name).stat().st_size, (folder / name).stat().st_mtime_ns) for name in names]
    how = [] if turned else ["as stored"]
    key = _key([files, max_side_px, extractor.record(), *how])
    path = work / "features.npz"
    kept = _load(path, key)
    if kept is None:
        kept = _extract(folder, names, max_side_px, KeypointExtractor(extractor, device), processes, progress, turned)
        save_npz(path, {"key": np.array(key), **kept})
    ends = np.cumsum(kept["counts"])[:-1]
    pixels, descriptors, colors = (np.split(kept[name], ends) for name in ("pixels", "descriptors", "colors"))
    stored = list(zip(pixels, descriptors, strict=True))
    return PhotographFeatures(names, kept["full_sizes"], kept["sizes"], stored, colors, key, kind_of(extractor.method))


def map_incrementally(
    work: Path,
    features: PhotographFeatures,
    cameras: PhotographCameras,
    exhaustive_up_to: int,
    overlap: int,
    seed: int,
    processes: WorkerPool,
    progress: bool = True,
) -> MappedPhotographs:
    """Match photographs, verify the matches, and map incrementally (Schonberger and Frahm, CVPR 2016).

    Finished steps are kept in `work`. For `exhaustive_up_to` and `overlap` see `photograph_pairs`. The processes match;
    COLMAP's bundle adjustment takes as many threads. MapError if the photographs do not overlap enough for any map.
    """
    seed %= 2**31  # COLMAP keeps it in an int
    pairs = photograph_pairs(len(features.names), exhaustive_up_to, overlap)
    key = _key([features.key, pairs.tolist()])
    database = work / "database.db"
    kept = _load(work / "matches.npz", key)
    if kept is None:
        with storing_in_database(database):
            matches = list(match_pairs(features.stored, pairs, work, processes, progress, features.kind))
        kept = {"matches": np.concatenate(matches), "counts": np.array([len(found) for found in matches])}
        save_npz(work / "matches.npz", {"key": np.array(key), **kept})
    intrinsics = [camera.todict() for camera in cameras.cameras]
    key = _key([key, intrinsics, cameras.camera_of.tolist(), cameras.given, seed])
    folder = work / "sparse"
    note = work / "sparse.json"
    if not (database.is_file() and folder.is_dir() and _note(note).get("key") == key):
        for leftover in (database, note):
            leftover.unlink(missing_ok=True)
        shutil.rmtree(folder, ignore_errors=True)
        matches = np.split(kept["matches"], np.cumsum(kept["counts"])[:-1])
        _fill(database, features, cameras, pairs, matches)
        model_sizes = _reconstruct(database, folder, len(features.names), cameras.given, seed, processes, progress)
        write_json(note, {"key": key, "model_sizes": model_sizes})
    return MappedPhotographs(read_model(folder), database, _note(note)["model_sizes"])


def _extract(
    folder: Path,
    names: list[str],
    max_side_px: int,
    extractor: KeypointExtractor,
    processes: WorkerPool,
    progress: bool,
    turned: bool = True,
) -> dict[str, NDArray[Any]]:
    full_sizes = []
    sizes = []

    def images() -> Iterator[NDArray[np.uint8]]:
        for name in names:
            rgb = photographs.read_photograph(folder / name, turned)
            reduced = photographs.reduce_photograph(rgb, max_side_px)
            full_sizes.append(rgb.shape[1::-1])
            sizes.append(reduced.shape[1::-1])
            yield reduced

    n = len(names)
    extracted = extract_with_colors(extractor, images(), n, processes, "map: extract", progress, same_size=False)
    kind = kind_of(extractor.config.method)
    found = [(*stored_keypoints(keypoints, kind), color) for keypoints, color in extracted]
    counts = np.array([len(color) for *_, color in found])
    parts = zip(("pixels", "descriptors", "colors"), zip(*found, strict=True), strict=True)
    joined = {name: np.concatenate(values) for name, values in parts}
    return {"full_sizes": np.array(full_sizes), "sizes": np.array(sizes), "counts": counts, **joined}


def _fill(
    database: Path,
    features: PhotographFeatures,
    cameras: PhotographCameras,
    pairs: NDArray[np.int64],
    matches: list[NDArray[np.uint32]],
) -> None:
    """Make a COLMAP database of photographs without poses, and write their matches into it."""
    import pycolmap

    model = pycolmap.Reconstruction()
    for camera in cameras.cameras:
        model.add_camera_with_trivial_rig(camera)
    for index, (name, row) in enumerate(zip(features.names, cameras.camera_of.tolist(), strict=True)):
        image = pycolmap.Image(name=name, camera_id=cameras.cameras[row].camera_id, image_id=index + 1)
        model.add_image_with_trivial_frame(image)
    with storing_in_database(database):
        fill_database(database, model, features.stored, features.kind)
        with pycolmap.Database.open(str(database)) as db:
            for (i, j), found in zip(pairs.tolist(), matches, strict=True):
                db.write_matches(i + 1, j + 1, found)


def _reconstruct(
    database: Path, folder: Path, n_images: int, given: bool, seed: int, processes: WorkerPool, progress: bool
) -> list[int]:
    """Verify matches, map, and write the largest model. Returns the number of photographs in each, largest first."""
    import pycolmap

    threads = processes.workers
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    options = pycolmap.IncrementalPipelineOptions(random_seed=seed, num_threads=threads, extract_colors=False)
    options.min_model_size = _LEAST_IMAGES
    options.ba_refine_focal_length = options.ba_refine_extra_params = not given
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = not given
    options.triangulation.random_seed = options.mapper.random_seed = seed
    options.mapper.num_threads = threads
    pycolmap.set_random_seed(seed)
    models = folder.with_name("models.partial")
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir()
    bar = tqdm(total=n_images, desc="map: register", disable=not progress, unit="image")
    steps: Any = {"initial_image_pair_callback": lambda: bar.update(2), "next_image_callback": lambda: bar.update(1)}
    with storing_in_database(database), quiet_colmap("ERROR"), bar:
        verifier = pycolmap.GeometricVerifierOptions(num_threads=threads)
        pycolmap.geometric_verification(str(database), verifier, two_view_geometry_options=verification)
        found = pycolmap.incremental_mapping(str(database), str(models), str(models), options, **steps)
    ordered = sorted(found.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    shutil.rmtree(models)
    if not ordered:
        enough = f"at least {_LEAST_IMAGES} sharp photographs that share most of what they show with the next"
        fix = f"Give {enough}, from different places; a focal length (map.photographs.camera_params) helps."
        value = f"{n_images} photographs, none placed"
        raise MapError("the photographs do not overlap enough for a map", value=value, fix=fix)
    write_model(ordered[0], models)
    os.replace(models, folder)
    return [model.num_reg_images() for model in ordered]


def _key(parts: list[Any]) -> str:
    text = json.dumps([_VERSION, parts], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _note(path: Path) -> dict[str, Any]:
    try:
        return read_json_object(path)
    except (OSError, ValueError):
        return {}


def _load(path: Path, key: str) -> dict[str, NDArray[Any]] | None:
    """Arrays of a finished step; None if it was not finished, or from other inputs."""
    try:
        kept = load_npz(path)
    except ValueError:
        return None
    return kept if str(kept.pop("key", "")) == key else None
