"""Compare localization with hloc (Sarlin et al., CVPR 2019) on the same features, maps and queries.

    python -m wheretolook_paper.studies.compare_hloc compare --sets '[building-700, scan.glb]' --out hloc.csv
    python -m wheretolook_paper.studies.compare_hloc compare --sets '[work/kitchen]' --features aliked \\
        --weights aliked-n16rot.pth --lightglue aliked_lightglue.pth --out aliked.csv
    python -m wheretolook_paper.studies.compare_hloc draw --tables '[hloc.csv, aliked.csv]' --figure hloc.png

Needs h5py, and hloc (https://github.com/cvg/Hierarchical-Localization) in the same environment; without hloc only this
project's methods are compared. A set is

- a generated scene, `<kind>-<seed>`, or a mesh in metres: it is mapped by rendered images, and the views that the scorer
  that ships, bins, most visible landmarks and a random draw select at `locations` locations are rendered as queries; or
- a folder with images/, cameras.txt of one camera, images.txt with all poses and an empty points3D.txt (COLMAP's text),
  and queries.txt: lines "image fold". The queries of a fold are localized in a map of all images but those of the fold.

hloc triangulates the map at the known poses (without hloc, the map stage does); each image is matched with the `partners`
nearest ones. hloc then matches each query with the `retrieved` mapping images that observe most of the landmarks that the
query matches, since weights of global descriptors are not assumed; its confidence is the number of inliers.

Methods: `hloc`; `first` (the paper's: landmarks, one RANSAC), `hypotheses` (landmarks, several hypotheses), `lightglue`
(the same after LightGlue with five mapping images). Times are those of matching and pose estimation, without features.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, get_args

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pycolmap
from jsonargparse import auto_cli
from tqdm.auto import tqdm

from wheretolook.commands.map import BuildMap
from wheretolook.commands.options import MeshSource, ScenesConfig
from wheretolook.commands.sample import Sample
from wheretolook.commands.scenes import Scenes
from wheretolook.dataset.config import Accuracy, SampleConfig
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.scene import Scene
from wheretolook.dataset.viewpoint_table import poses as poses_of_table
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.scoring import score_scenes
from wheretolook.features.extractor import KINDS, ExtractorConfig, KeypointExtractor, Keypoints, kind_of
from wheretolook.figures.floor_plan import save_figure
from wheretolook.geometry.camera import Camera, camera_of, write_cameras
from wheretolook.geometry.pose_files import images_text
from wheretolook.geometry.poses import Float, camera_centers, pose_error
from wheretolook.localization.config import LabelConfig, LocalizerConfig
from wheretolook.localization.localizer import Localizer
from wheretolook.localization.rig import Look
from wheretolook.localization.rig_localization import POSES_OF_AN_IMAGE
from wheretolook.mapping.colmap_model import colmap_poses, holds_model, read_model, registered_names
from wheretolook.mapping.config import MapConfig
from wheretolook.mapping.feature_files import read_features
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks
from wheretolook.mapping.map_folder import DATABASE_FILE, MapRun
from wheretolook.mapping.photographs import read_photograph
from wheretolook.mapping.triangulation import triangulate_model
from wheretolook.scenes.config import SceneKind
from wheretolook.scorers.weights import resolve_weights
from wheretolook.utils.devices import usable_device
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import atomic_write, write_bytes, write_text
from wheretolook.utils.processes import WorkerPool
from wheretolook_paper.relocalization import precision_area, precision_over_coverage

MATCHERS = {"aliked": "aliked+lightglue", "disk": "disk+lightglue", "opencv": "NN-ratio"}  # of hloc, by extractor
LABELS = {"aliked": "ALIKED", "disk": "DISK", "opencv": "SIFT"}
COLORS = {"hloc": "#c44e52", "first": "#8c8c8c", "hypotheses": "#4c72b0", "lightglue": "#55a868"}
ACCURACIES: Mapping[str, Accuracy] = {"5 cm, 0.4 deg": (0.05, 0.4), "25 cm, 2 deg": (0.25, 2.0)}
AHEAD_M = 3.0  # of a camera, of the point that decides which images are matched
SELECTING = ("set", "bins", "visible", "random")  # methods whose views are the queries in a rendered scene
DIRECTIONS = 24  # of a location, that they select from
NO_HLOC = (
    "hloc is not installed, so only this project's methods are compared. To install it:\n"
    "    git clone --recursive https://github.com/cvg/Hierarchical-Localization && pip install ./Hierarchical-Localization"
)


@dataclass(frozen=True, eq=False)
class Fold:
    """A map of one fold, hloc's files, and the queries with their true poses (3, 4)."""

    folder: Path
    model: Path
    features: Path
    landmarks: Landmarks
    camera: Camera
    queries: Mapping[str, Float]


@dataclass(frozen=True)
class Pose:
    """An estimated pose (3, 4), None without one; confidences, by accuracy; seconds that it took."""

    cam_from_world: Float | None
    confidence: Mapping[str, float]
    seconds: float


def main(
    sets: list[str],
    out: Path,
    features: str = "opencv",
    weights: str = "",
    lightglue: str = "",
    retrieved: int = 10,
    partners: int = 20,
    locations: int = 40,
    images: int = 100,
    work: Path = Path("hloc-work"),
    workers: int = 1,
    device: str = "cpu",
) -> pd.DataFrame:
    """Localize the queries of all sets by all methods, write every pose's errors to `out`, and print a summary.

    Args:
        sets: generated scenes such as building-700, mesh files, or folders.
        out: CSV file.
        features: opencv (SIFT), aliked or disk.
        weights: weights of learned features.
        lightglue: weights of LightGlue, for one more method.
        retrieved: mapping images that hloc matches a query with.
        partners: images that each mapping image is matched with.
        locations: locations in a mesh or generated scene, with up to four queries each.
        images: images that a mesh or generated scene is mapped from.
        work: folder of scenes, maps and features, which are reused.
        workers: worker processes that map.
        device: where to compute.
    """
    if find_spec("hloc") is None:
        print(NO_HLOC)
    rows = []
    device = usable_device(device)
    extractor = KeypointExtractor(ExtractorConfig(features, weights=weights), device)
    for source in sets:
        folder = Path(source)
        if not folder.is_dir():
            folder = render_set(source, locations, images, work, workers, device)
        for fold in _folds(folder, extractor, partners, work / folder.name / features, workers):
            for method, poses in _methods(fold, features, lightglue, retrieved, device).items():
                for name, pose in poses.items():
                    estimated = np.full((3, 4), np.nan) if pose.cam_from_world is None else pose.cam_from_world
                    error_m, error_deg = pose_error(estimated, fold.queries[name])
                    row = {"set": folder.name, "features": features, "method": method, "query": name}
                    confidences = {f"confidence at {at}": value for at, value in pose.confidence.items()}
                    errors = {"error_m": float(error_m), "error_deg": float(error_deg)}
                    rows.append({**row, **errors, **confidences, "seconds": pose.seconds})
        table = pd.DataFrame(rows)
        write_text(out, table.to_csv(index=False, float_format="%.6g", lineterminator="\n"))
    print(summarize(table).to_string(index=False))
    return table


def map_source(source: str, images: int, work: Path, workers: int = 1, device: str = "cpu") -> SceneFolder:
    """Map a mesh or a generated scene by rendered images, as a dataset of one scene in `work`, which is reused.

    Raises ConfigError if the source is neither.
    """
    kind, _, seed = source.rpartition("-")
    if Path(source).is_file():
        scenes = ScenesConfig(train=0, test=0, meshes=(MeshSource(Path(source)),))
    elif kind in get_args(SceneKind) and seed.isdecimal():
        scenes = ScenesConfig(train=0, test=1, seed=int(seed), kinds=(kind,))  # type: ignore[arg-type]
    else:
        fix = f"Name a folder, a mesh file, or one of {', '.join(get_args(SceneKind))} with a seed: building-700."
        raise ConfigError("there is no such set", value=source, fix=fix)
    dataset: dict[str, Any] = {"data": work, "name": f"scene-{Path(source).stem}", "device": device}
    Scenes(**dataset, scenes=scenes).run()
    BuildMap(**dataset, mapping=MapConfig(n_images=images, keep_images=True), label=LabelConfig(workers=workers)).run()
    (scene,) = Dataset.load(work / dataset["name"]).scenes
    return scene


def render_set(source: str, locations: int, images: int, work: Path, workers: int = 1, device: str = "cpu") -> Path:
    """Map a mesh or a generated scene, render the queries, and return the folder of the set, which is reused.

    Raises ConfigError if the source is neither.
    """
    out = work / f"{Path(source).stem}-{images}-{locations}"
    if (out / "queries.txt").is_file():
        return out
    mapped = map_source(source, images, work, workers, device)
    sample = SampleConfig(keep=0, max_locations=locations, max_directions=DIRECTIONS)
    (scene,) = Sample(data=work, name=mapped.folder.parent.name, device=device, sample=sample).run().scenes
    table = scene.read_table()
    weights = resolve_weights()
    assert weights is not None
    config = EvaluateConfig(methods=SELECTING)
    scores, _ = score_scenes([scene], [table], config, {weights: "set"}, device, True, None)
    places = table["location_id"].to_numpy()
    rows = np.unique([pd.Series(values).groupby(places).idxmax() for values in scores.values()])
    model = read_model(scene.map)
    names = [*registered_names(model).values()]
    shutil.copytree(scene.map / "images", out / "images", dirs_exist_ok=True)
    queries = {f"query-{row:05d}.png": pose for row, pose in zip(rows, poses_of_table(table)[rows], strict=True)}
    renderer = Scene(scene, device=device).renderer
    for name, pose in tqdm(queries.items(), desc="render queries"):
        (rgb,) = renderer.render(scene.camera, pose[None]).rgb
        write_bytes(out / "images" / name, cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes())
    write_posed(out, scene.camera, dict(zip(names, colmap_poses(scene.map, model), strict=True)) | queries)
    write_text(out / "queries.txt", "".join(f"{name} views\n" for name in queries))
    return out


def write_posed(folder: Path, camera: Camera, poses: Mapping[str, Float]) -> None:
    """Write a COLMAP model of images of one camera at poses (3, 4) by name, without points, as text."""
    write_cameras({1: camera}, folder / "cameras.txt")
    write_text(folder / "images.txt", images_text(poses, [*poses.values()]))
    write_text(folder / "points3D.txt", "")


def summarize(table: pd.DataFrame) -> pd.DataFrame:
    """Summarize poses by set, features, method and accuracy: recall, precision area, confident poses, median time."""
    rows = []
    for (name, features, method), part in table.groupby(["set", "features", "method"], sort=False):
        for at, (limit_m, limit_deg) in ACCURACIES.items():
            right = ((part["error_m"] <= limit_m) & (part["error_deg"] <= limit_deg)).to_numpy()
            confidence = part[f"confidence at {at}"].to_numpy(float)
            row = {"set": name, "features": features, "method": method, "accuracy": at, "queries": len(part)}
            row |= {"recall": right.mean(), "precision_area": precision_area(confidence, right)}
            sure = confidence >= 0.99
            if method != "hloc":
                row |= {"confident": sure.mean(), "right_of_confident": right[sure].mean() if sure.any() else np.nan}
            rows.append(row | {"seconds": part["seconds"].median()})
    return pd.DataFrame(rows)


def draw(tables: list[Path], figure: Path, accuracy: str = "5 cm, 0.4 deg") -> None:
    """Draw precision over coverage of the poses in tables of `main`: a panel for each set and features."""
    table = pd.concat([pd.read_csv(path) for path in tables], ignore_index=True)
    limit_m, limit_deg = ACCURACIES[accuracy]
    table["right"] = (table["error_m"] <= limit_m) & (table["error_deg"] <= limit_deg)
    panels = list(table.groupby(["set", "features"], sort=False))
    canvas, axes = plt.subplots(1, len(panels), figsize=(2.6 * len(panels), 2.6), layout="constrained", squeeze=False)
    for axis, ((name, features), panel) in zip(axes[0], panels, strict=True):
        for method, part in panel.groupby("method", sort=False):
            confidence = part[f"confidence at {accuracy}"].to_numpy(float)
            coverage, precision = precision_over_coverage(confidence, part["right"].to_numpy())
            axis.plot(coverage, precision, color=COLORS[str(method)], label=method)
        axis.set(title=f"{name}, {LABELS[str(features)]}", xlabel="coverage", ylim=(0.55, 1.01), xlim=(0, 1))
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("precision")
    handles = {text: line for axis in axes[0] for line, text in zip(*axis.get_legend_handles_labels(), strict=True)}
    canvas.legend(handles.values(), handles, frameon=False, loc="outside right center")
    save_figure(canvas, figure)


def _store_features(images: Mapping[str, Path], extractor: KeypointExtractor, path: Path) -> None:
    """Write the features of images, by name, as hloc does; nothing if the file exists."""
    import h5py

    if path.is_file():
        return
    with atomic_write(path) as partial, h5py.File(partial, "w") as file:
        for name, image in tqdm(images.items(), desc="features"):
            rgb = read_photograph(image)
            keypoints = extractor.extract(rgb)
            group = file.create_group(name)
            group["keypoints"] = keypoints.pixels - 0.5  # hloc counts from the centre of the top-left pixel
            group["descriptors"] = keypoints.descriptors.T
            group["image_size"] = np.array(rgb.shape[1::-1])


def _nearest(cam_from_world: Sequence[Float], count: int) -> list[tuple[int, int]]:
    """Return pairs of images: each with those whose point `AHEAD_M` ahead of the camera is nearest to its own."""
    poses = np.stack(cam_from_world)
    ahead = camera_centers(poses) + AHEAD_M * poses[:, 2, :3]
    distance = np.linalg.norm(ahead[:, None] - ahead, axis=2)
    order = np.argsort(distance, axis=1, kind="stable")[:, 1 : count + 1]
    return sorted({(min(a, int(b)), max(a, int(b))) for a, row in enumerate(order) for b in row})


def _folds(folder: Path, extractor: KeypointExtractor, partners: int, work: Path, workers: int) -> Iterator[Fold]:
    """Map the images outside each fold, and yield the map with the fold's queries."""
    reference = read_model(folder)
    names = [*registered_names(reference).values()]
    true = dict(zip(names, colmap_poses(folder, reference), strict=True))
    (camera,) = reference.cameras.values()
    seen_by = camera_of(camera.model_name, camera.width, camera.height, camera.params)
    fold_of = dict(line.split() for line in (folder / "queries.txt").read_text(encoding="utf-8").splitlines())
    method = extractor.config.method
    stored = work / f"feats-{kind_of(method).name}.h5"
    _store_features({name: folder / "images" / name for name in names}, extractor, stored)
    has_hloc = find_spec("hloc") is not None
    for fold in dict.fromkeys(fold_of.values()):
        out = work / f"fold-{fold}"
        mapping = {name: pose for name, pose in true.items() if fold_of.get(name) != fold}
        pairs = _nearest([*mapping.values()], partners)
        model = out / ("model" if has_hloc else "model-without-hloc")
        if not holds_model(model):
            write_posed(out / "reference", seen_by, mapping)
            if has_hloc:
                _triangulate_by_hloc(out / "reference", folder / "images", pairs, stored, model, MATCHERS[method])
            else:
                _triangulate(out / "reference", pairs, stored, model, extractor.config, workers)
        landmarks = load_colmap_landmarks(model, stored, ambiguity=False)
        queries = {name: true[name] for name in names if fold_of.get(name) == fold}
        yield Fold(out, model, stored, landmarks, seen_by, queries)


def _triangulate_by_hloc(
    reference: Path, images: Path, pairs: Sequence[tuple[int, int]], features: Path, model: Path, matcher: str
) -> None:
    """Match pairs of the images of a reference model and triangulate at its poses, all by hloc."""
    from hloc import match_features, triangulation

    pairs_file = reference.parent / "pairs.txt"
    names = [*registered_names(read_model(reference)).values()]
    write_text(pairs_file, "\n".join(f"{names[a]} {names[b]}" for a, b in pairs))
    matches = features.with_name("mapping-matches.h5")  # shared by all folds
    match_features.main(match_features.confs[matcher], pairs_file, features, matches=matches)
    # pycolmap 4 ignores the pairs that hloc verifies by the known poses, since it leaves their configuration open
    triangulation.main(model, reference, images, pairs_file, features, matches, estimate_two_view_geometries=True)


def _triangulate(
    reference: Path,
    pairs: Sequence[tuple[int, int]],
    features: Path,
    model: Path,
    extractor: ExtractorConfig,
    workers: int,
) -> None:
    """Match pairs of the images of a reference model and triangulate at its poses, as the map stage does."""
    database = reference.with_name(DATABASE_FILE)
    database.unlink(missing_ok=True)  # of an interrupted run
    posed = read_model(reference)
    _, stored = read_features(features, [*registered_names(posed).values()])
    colors = [np.zeros((len(pixels), 3), np.uint8) for pixels, _ in stored]
    # tracks as long as hloc asks for
    config = MapConfig(extractor=extractor, two_view_landmarks=False)
    with WorkerPool(workers) as processes:
        run = MapRun(config, processes)
        triangulated = triangulate_model(database, posed, stored, colors, np.array(pairs), run)
    model.mkdir(parents=True, exist_ok=True)
    triangulated.write_binary(str(model))


def _methods(fold: Fold, features: str, lightglue: str, retrieved: int, device: str) -> dict[str, dict[str, Pose]]:
    """Localize the queries of a fold by every method."""
    kind, stored = read_features(fold.features, [*fold.queries])
    assert kind == KINDS[fold.landmarks.features]
    queries = {
        name: Keypoints(pixels, kind.restore(descriptors))
        for name, (pixels, descriptors) in zip(fold.queries, stored, strict=True)
    }
    configs = {"first": LocalizerConfig(), "hypotheses": LocalizerConfig(method="hypotheses")}
    if lightglue:
        configs["lightglue"] = LocalizerConfig(method="hypotheses", lightglue=lightglue)
    results = {}
    for method, config in configs.items():
        localizer = Localizer(fold.landmarks, fold.camera, config, None, device, fold.model, fold.features)
        localizer.match([next(iter(queries.values()))])  # what is read or compiled once is not timed
        results[method] = {name: _localize(localizer, query) for name, query in tqdm(queries.items(), desc=method)}
    if find_spec("hloc") is not None:
        results["hloc"] = _by_hloc(fold, features, _retrieve(fold, queries, retrieved, device))
    return results


def _localize(localizer: Localizer, query: Keypoints) -> Pose:
    start = time.perf_counter()
    found = localizer.match_descriptors([query])
    looks = [Look.of(query.pixels, one, localizer.camera) for one in localizer.by_lightglue([query], found)]
    poses = localizer.joint.single_view_poses(looks[0], POSES_OF_AN_IMAGE)
    if localizer.config.lightglue:
        poses += localizer.joint.single_view_poses(Look.of(query.pixels, found[0], localizer.camera), POSES_OF_AN_IMAGE)
    joint = localizer.joint.localize(looks, [poses])
    seconds = time.perf_counter() - start
    if joint.status != "localized":
        return Pose(None, dict.fromkeys(ACCURACIES, np.nan), seconds)
    confidence = {at: float(joint.probabilities(limits)[0]) for at, limits in ACCURACIES.items()}
    return Pose(joint.rig_from_world, confidence, seconds)


def _retrieve(fold: Fold, queries: Mapping[str, Keypoints], count: int, device: str) -> dict[str, list[str]]:
    """Return the mapping images that observe most of the landmarks that each query matches."""
    localizer = Localizer(fold.landmarks, fold.camera, device=device)
    model = read_model(fold.model)
    row_of = {int(number): row for row, number in enumerate(fold.landmarks.ids)}
    observed = {
        image.name: np.array([row_of[p.point3D_id] for p in image.points2D if p.point3D_id in row_of], dtype=int)
        for image in model.images.values()
    }
    found = {}
    for name, query in queries.items():
        is_matched = np.isin(np.arange(len(fold.landmarks)), localizer.match([query])[0].landmarks)
        votes = {image: int(is_matched[rows].sum()) for image, rows in observed.items()}
        found[name] = sorted(votes, key=lambda image: -votes[image])[:count]
    return found


def _by_hloc(fold: Fold, features: str, retrieved: Mapping[str, Sequence[str]]) -> dict[str, Pose]:
    """Match by hloc's matcher with the retrieved images, and localize by its `pose_from_cluster`."""
    from hloc import localize_sfm, match_features

    model = pycolmap.Reconstruction(fold.model)
    number_of = {image.name: number for number, image in model.images.items()}
    # hloc's default limit of an inlier
    localizer = localize_sfm.QueryLocalizer(model, {"estimation": {"ransac": {"max_error": 12.0}}})
    camera = pycolmap.Camera(**fold.camera.colmap.record())
    matches = fold.folder / "query-matches.h5"
    pairs = fold.folder / "query-pairs.txt"
    write_text(pairs, "\n".join(f"{query} {image}" for query, images in retrieved.items() for image in images))
    matches.unlink(missing_ok=True)
    start = time.perf_counter()
    match_features.main(match_features.confs[MATCHERS[features]], pairs, fold.features, matches=matches)
    # of few queries most of the time is that of loading the matcher
    matching = (time.perf_counter() - start) / len(retrieved) if len(retrieved) >= 10 else np.nan
    poses = {}
    for query, images in tqdm(retrieved.items(), desc="hloc"):
        start = time.perf_counter()
        numbers = [number_of[image] for image in images]
        found, _ = localize_sfm.pose_from_cluster(localizer, query, camera, numbers, fold.features, matches)
        seconds = matching + time.perf_counter() - start
        if found is None:
            poses[query] = Pose(None, dict.fromkeys(ACCURACIES, np.nan), seconds)
            continue
        confidence = dict.fromkeys(ACCURACIES, float(found["num_inliers"]))
        poses[query] = Pose(found["cam_from_world"].matrix(), confidence, seconds)
    return poses


if __name__ == "__main__":
    auto_cli({"compare": main, "draw": draw}, as_positional=False)
