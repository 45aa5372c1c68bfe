"""Poses and points of photographs by COLMAP's incremental mapping, step by step: a finished step is not done again."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.features.extraction import KeypointExtractor
from wheretolook.features.keypoints import ExtractorConfig
from wheretolook.mapping.colmap_model import read_model
from wheretolook.mapping.photographs import (
    PhotographCameras,
    list_photographs,
    photograph_pairs,
    read_photograph,
    reduce_photograph,
)
from wheretolook.mapping.triangulation import Stored, fill_database, match_pairs, stored_keypoints
from wheretolook.utils.colmap import quiet_colmap
from wheretolook.utils.errors import MapError
from wheretolook.utils.processes import Processes

_LEAST_IMAGES = 3  # of a model: two photographs alone fix no camera
_VERSION = 1  # of what is kept of the steps


@dataclass(frozen=True, eq=False)
class PhotographFeatures:
    """Keypoints of photographs.

    Attributes:
        names: of the I photographs, relative to their folder.
        full_sizes: (I, 2) int64, width and height as taken, upright.
        sizes: (I, 2) int64, width and height as mapped.
        stored: pixels and descriptors of each photograph's keypoints.
        colors: (N_i, 3) uint8 of each photograph's keypoints.
        key: changes with all that the keypoints depend on.
    """

    names: list[str]
    full_sizes: NDArray[np.int64]
    sizes: NDArray[np.int64]
    stored: list[Stored]
    colors: list[NDArray[np.uint8]]
    key: str


@dataclass(frozen=True, eq=False)
class MappedPhotographs:
    """What incremental mapping made of photographs.

    Attributes:
        model: the largest `pycolmap.Reconstruction`, in a frame and a scale of its own. Image i of the names has id
            i + 1.
        database: COLMAP's database of keypoints and verified matches.
        model_sizes: photographs in each model, the largest first.
    """

    model: Any
    database: Path
    model_sizes: list[int]


def photograph_features(
    folder: Path,
    work: Path,
    max_side_px: int,
    extractor: ExtractorConfig,
    processes: Processes,
    device: str = "cpu",
    progress: bool = True,
) -> PhotographFeatures:
    """Keypoints of all photographs in a folder, by the project's extractor: a later localization uses the same.

    Raises:
        MapError: there are fewer than two photographs, or one cannot be read.
    """
    names = list_photographs(folder)
    files = [(name, (folder / name).stat().st_size, (folder / name).stat().st_mtime_ns) for name in names]
    key, path = _key([files, max_side_px, asdict(extractor)]), work / "features.npz"
    kept = _load(path, key)
    if kept is None:
        kept = _extract(folder, names, max_side_px, extractor, processes, device, progress)
        _save(path, key, kept)
    ends = np.cumsum(kept["counts"])[:-1]
    pixels, descriptors, colors = (np.split(kept[name], ends) for name in ("pixels", "descriptors", "colors"))
    return PhotographFeatures(
        names, kept["full_sizes"], kept["sizes"], list(zip(pixels, descriptors, strict=True)), colors, key
    )


def map_incrementally(
    work: Path,
    features: PhotographFeatures,
    cameras: PhotographCameras,
    exhaustive_up_to: int,
    overlap: int,
    seed: int,
    processes: Processes,
    progress: bool = True,
) -> MappedPhotographs:
    """Match photographs, verify the matches, and map incrementally (Schonberger and Frahm, CVPR 2016).

    Args:
        work: folder where finished steps are kept.
        features: keypoints of the photographs.
        cameras: intrinsics to start from, or to keep.
        exhaustive_up_to: see `photograph_pairs`.
        overlap: see `photograph_pairs`.
        seed: of COLMAP's sampling.
        processes: match; COLMAP's bundle adjustment takes as many threads.
        progress: show progress bars.

    Raises:
        MapError: the photographs do not overlap enough for any map.
    """
    seed %= 2**31  # COLMAP keeps it in an int
    pairs = photograph_pairs(len(features.names), exhaustive_up_to, overlap)
    key = _key([features.key, pairs.tolist()])
    kept = _load(work / "matches.npz", key)
    if kept is None:
        matches = list(match_pairs(features.stored, pairs, work, processes, progress))
        kept = {"matches": np.concatenate(matches), "counts": np.array([len(found) for found in matches])}
        _save(work / "matches.npz", key, kept)
    intrinsics = [camera.todict() for camera in cameras.cameras]
    key = _key([key, intrinsics, cameras.camera_of.tolist(), cameras.given, seed])
    database, folder, note = work / "database.db", work / "sparse", work / "sparse.json"
    if not (database.is_file() and folder.is_dir() and _note(note).get("key") == key):
        for leftover in (database, note):
            leftover.unlink(missing_ok=True)
        shutil.rmtree(folder, ignore_errors=True)
        matches = np.split(kept["matches"], np.cumsum(kept["counts"])[:-1])
        _fill(database, features, cameras, pairs, matches)
        model_sizes = _reconstruct(database, folder, len(features.names), cameras.given, seed, processes, progress)
        note.write_text(json.dumps({"key": key, "model_sizes": model_sizes}))
    return MappedPhotographs(read_model(folder), database, _note(note)["model_sizes"])


def _extract(
    folder: Path, names: list[str], max_side_px: int, config: ExtractorConfig, processes: Processes, device: str,
    progress: bool,
) -> dict[str, NDArray[Any]]:  # fmt: skip
    extractor = KeypointExtractor(config, device)
    full_sizes, sizes, pixels, descriptors, colors = [], [], [], [], []
    waiting: list[NDArray[np.uint8]] = []

    def photographs() -> Iterator[NDArray[np.uint8]]:
        for name in names:
            rgb = read_photograph(folder / name)
            full_sizes.append(rgb.shape[1::-1])
            waiting.append(reduce_photograph(rgb, max_side_px))
            sizes.append(waiting[-1].shape[1::-1])
            yield waiting[-1]

    # one at a time on a GPU: its batches are of images of one size
    extracted = (
        (extractor.extract(rgb) for rgb in photographs())
        if extractor.on_gpu
        else extractor.extract_many(photographs(), processes)
    )
    with closing(extracted):
        for found in tqdm(extracted, "map: extract", total=len(names), disable=not progress, unit="image"):
            rgb = waiting.pop(0)
            column, row = found.pixels.astype(np.int64).T
            colors.append(rgb[np.clip(row, 0, rgb.shape[0] - 1), np.clip(column, 0, rgb.shape[1] - 1)])
            stored = stored_keypoints(found)
            pixels.append(stored[0])
            descriptors.append(stored[1])
    return {
        "full_sizes": np.array(full_sizes, dtype=np.int64),
        "sizes": np.array(sizes, dtype=np.int64),
        "counts": np.array([len(one) for one in pixels]),
        "pixels": np.concatenate(pixels),
        "descriptors": np.concatenate(descriptors),
        "colors": np.concatenate(colors),
    }


def _fill(
    database: Path,
    features: PhotographFeatures,
    cameras: PhotographCameras,
    pairs: NDArray[np.int64],
    matches: list[NDArray[np.uint32]],
) -> None:
    """Make a database of photographs without poses, with their matches."""
    import pycolmap

    model = pycolmap.Reconstruction()
    for camera in cameras.cameras:
        model.add_camera_with_trivial_rig(camera)
    for index, (name, row) in enumerate(zip(features.names, cameras.camera_of.tolist(), strict=True)):
        image = pycolmap.Image(name=name, camera_id=cameras.cameras[row].camera_id, image_id=index + 1)
        model.add_image_with_trivial_frame(image)
    fill_database(database, model, features.stored)
    with pycolmap.Database.open(str(database)) as db:
        for (i, j), found in zip(pairs.tolist(), matches, strict=True):
            db.write_matches(i + 1, j + 1, found)


def _reconstruct(
    database: Path, folder: Path, n_images: int, given: bool, seed: int, processes: Processes, progress: bool
) -> list[int]:
    """Verify matches, map, and write the largest model. Returns the photographs in each, the largest first."""
    import pycolmap

    threads = processes.workers
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    options = pycolmap.IncrementalPipelineOptions(
        random_seed=seed, num_threads=threads, extract_colors=False, min_model_size=_LEAST_IMAGES,
        ba_refine_focal_length=not given, ba_refine_extra_params=not given,
    )  # fmt: skip
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = not given
    options.triangulation.random_seed = options.mapper.random_seed = seed
    options.mapper.num_threads = threads
    pycolmap.set_random_seed(seed)
    models = folder.with_name("models.partial")
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir()
    with (
        quiet_colmap("ERROR"),
        tqdm(total=n_images, desc="map: register", disable=not progress, unit="image") as bar,
    ):
        pycolmap.geometric_verification(
            str(database), pycolmap.GeometricVerifierOptions(num_threads=threads),
            two_view_geometry_options=verification,
        )  # fmt: skip
        found = pycolmap.incremental_mapping(
            str(database), str(models), str(models), options,
            initial_image_pair_callback=lambda: bar.update(2), next_image_callback=lambda: bar.update(1),
        )  # fmt: skip
    ordered = sorted(found.values(), key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    shutil.rmtree(models)
    if not ordered:
        raise MapError(
            "the photographs do not overlap enough for a map", value=f"{n_images} photographs, none placed",
            fix=f"Give at least {_LEAST_IMAGES} sharp photographs that share most of what they show with the next, "
            "from different places; a focal length (map.photographs.camera_params) helps.",
        )  # fmt: skip
    models.mkdir()
    ordered[0].write_binary(str(models))
    os.replace(models, folder)
    return [model.num_reg_images() for model in ordered]


def _key(parts: list[Any]) -> str:
    text = json.dumps([_VERSION, parts], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _note(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError):
        return {}


def _load(path: Path, key: str) -> dict[str, NDArray[Any]] | None:
    """Arrays of a finished step; None if it was not finished, or from other inputs."""
    try:
        with np.load(path) as stored:
            kept = {name: stored[name] for name in stored.files}
    except Exception:  # a damaged zip raises many kinds of errors, and is then made anew
        return None
    return kept if str(kept.pop("key", "")) == key else None


def _save(path: Path, key: str, arrays: dict[str, NDArray[Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        np.savez(file, **{"key": np.array(key), **arrays})  # type: ignore[arg-type]  # its stub takes a flag by name
    os.replace(partial, path)
