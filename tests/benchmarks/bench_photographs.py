"""How well methods rank real photographs: blocks of neighbours are left out of a map, and localized against the rest.

    python tests/benchmarks/bench_photographs.py --images my/photographs --work work/mine --out mine.csv
    python tests/benchmarks/bench_photographs.py --poses 7-scenes/redkitchen/seq-01 --work work/kitchen

All photographs are mapped once, as `wheretolook map --images` does, or from the poses beside them (7-Scenes layout:
frame-*.color.*, .depth.png, .pose.txt with world_from_cam in metres). Such poses choose the pairs to match and the
first triangulation; bundle adjustment then refines them and the focal length, and the result is fitted to them. Then
blocks of consecutive photographs are left out, from a few to half of all (`--largest`). Each time the rest is
triangulated anew at the poses of the full map, from the same matches, and every photograph left out is localized by the
project's localizer on that map. It is good within 5 cm and 0.4 degrees of its pose in the full map. A map without a
scale is brought to a median depth of 5 m; there the limit is 1 % of the median depth of the landmarks that the
photograph observes.

The table has, for each method: AUC over all photographs left out, with a 95 % interval by resampling blocks; the
expected calibration error (ECE) of probabilities; and, of `expected-inliers`, real over expected inliers: of the views
localized well, and of all views, where those not localized well count as none; and the share of views that are like
those the method has learnt from. Photographs must have one camera.
`--work` keeps maps and labels, so that other weights are quickly scored; remove it if photographs or settings change.
`views.csv` in it has every view.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pycolmap
import torch
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score
from tqdm.auto import tqdm

from wheretolook.evaluation.bootstrap import PERCENTILES
from wheretolook.evaluation.calibration import expected_calibration_error
from wheretolook.evaluation.scores import is_probability
from wheretolook.features.keypoints import Keypoints
from wheretolook.geometry.camera import Camera, PinholeCamera, cameras_by_id, only_camera
from wheretolook.geometry.poses import Float, camera_centers, invert_poses, pose_error
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.labelling.localizer import Localizer
from wheretolook.mapping.colmap_model import colmap_poses, holds_model, read_model
from wheretolook.mapping.config import MapConfig, PhotographsConfig
from wheretolook.mapping.incremental import photograph_features
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks
from wheretolook.mapping.photograph_map import map_photographs
from wheretolook.mapping.photographs import SUFFIXES
from wheretolook.mapping.scale import Similarity, fit_similarity
from wheretolook.mapping.triangulation import (
    Stored,
    choose_pairs,
    fill_database,
    match_pairs,
    shrink_depth,
    surface_overlap,
)
from wheretolook.methods.registry import check_method, make_scorer
from wheretolook.utils.colmap import quiet_colmap
from wheretolook.utils.errors import OutOfRangeWarning
from wheretolook.utils.processes import Processes
from wheretolook.viewpoints.table import LOCALIZED
from wheretolook.visibility.hidden_points import HiddenPointRemoval
from wheretolook.visibility.occlusion import NoOcclusion, OcclusionModel

MAX_ERROR_M, MAX_ERROR_DEG = 0.05, 0.4
MAX_ERROR_OF_DEPTH = 0.01  # where there is no scale
DEPTH_M = (
    MAX_ERROR_M / MAX_ERROR_OF_DEPTH
)  # that a map without a scale is brought to, where the two limits are the same
PARTNERS = 20  # that each photograph with a pose is matched with
ROUNDS = 3  # of triangulation and bundle adjustment
EXPECTED = "expected-inliers"
MAP = MapConfig()


@dataclass(frozen=True, eq=False)
class FullMap:
    """The map of all photographs. Photograph i has COLMAP's id i + 1, in the database as well."""

    model: Any  # `pycolmap.Reconstruction`
    database: Path
    names: list[str]
    stored: list[Stored]
    camera: Camera
    poses: dict[int, Float]  # of the photographs that have one, by their row
    limit_m: dict[int, float]  # within which each counts as localized well


def posed_model(camera: Any, names: list[str], poses: Mapping[int, Float], stored: list[Stored]) -> Any:
    """A reconstruction of photographs with poses (3, 4), by their rows, and with keypoints, but without points."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    for row, pose in poses.items():
        image = pycolmap.Image(name=names[row], camera_id=camera.camera_id, image_id=row + 1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in stored[row][0].astype(float)])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3]))
    return model


def triangulate(model: Any, database: Path) -> Any:
    """Points of a model of images with poses, which stay, from the matches between them in a database."""
    options = pycolmap.IncrementalPipelineOptions(random_seed=0, num_threads=1, extract_colors=False)
    options.image_names = [image.name for image in model.images.values()]
    options.triangulation.random_seed = options.mapper.random_seed = 0
    options.triangulation.ignore_two_view_tracks = not MAP.two_view_landmarks
    options.triangulation.min_angle = options.mapper.filter_min_tri_angle = MAP.min_triangulation_angle_deg
    with tempfile.TemporaryDirectory() as folder, quiet_colmap("ERROR"):
        model = pycolmap.triangulate_points(model, str(database), folder, folder, options=options)
    model.update_point_3d_errors()
    return model


def map_known_poses(folder: Path, work: Path, focal_px: float) -> None:
    """Map photographs in the layout of 7-Scenes into `work/map`, in the frame of their poses."""
    colors = sorted(path for path in folder.glob("*.color.*") if path.suffix in SUFFIXES)
    for name in ("images", "photographs"):
        (work / name).mkdir(parents=True, exist_ok=True)
    for path in colors:
        if not (work / "images" / path.name).exists():
            (work / "images" / path.name).symlink_to(path.resolve())
    stems = [path.name.partition(".color.")[0] for path in colors]
    poses = invert_poses(np.stack([np.loadtxt(folder / f"{stem}.pose.txt")[:3] for stem in stems]))
    depth = [cv2.imread(str(folder / f"{stem}.depth.png"), cv2.IMREAD_UNCHANGED) for stem in stems]
    depth_m = np.stack(
        [np.where(one < 65535, one * np.float32(1e-3), np.float32(0)) for one in map(shrink_depth, depth)]
    )
    with Processes(1) as processes:
        features = photograph_features(work / "images", work / "photographs", 0, MAP.extractor, processes)
        names, stored = features.names, features.stored
        pinhole = PinholeCamera(*features.sizes[0].tolist(), focal_px)
        pairs = choose_pairs(surface_overlap(pinhole, poses, depth_m), PARTNERS)
        camera = pycolmap.Camera(camera_id=1, **pinhole.colmap.record())
        model = posed_model(camera, names, dict(enumerate(poses)), stored)
        database = work / "photographs" / "database.db"
        database.unlink(missing_ok=True)
        fill_database(database, model, stored)
        found = match_pairs(stored, pairs, work, processes)
        with pycolmap.Database.open(str(database)) as db:
            for (i, j), matches in zip(pairs.tolist(), found, strict=True):
                db.write_matches(i + 1, j + 1, matches)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.solver_options.num_threads, options.ceres.solver_options.function_tolerance = 1, 1e-6
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    with quiet_colmap("ERROR"):
        matcher = pycolmap.GeometricVerifierOptions(num_threads=1)
        pycolmap.geometric_verification(str(database), matcher, two_view_geometry_options=verification)
        for _ in tqdm(range(ROUNDS), "map: adjust", unit="round"):
            adjusted = dict(enumerate(colmap_poses(work, model)))
            model = triangulate(posed_model(model.cameras[1], names, adjusted, stored), database)
            adjusting = pycolmap.BundleAdjustmentConfig()
            for number in model.images:
                adjusting.add_image(number)
            adjusting.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
            pycolmap.create_default_bundle_adjuster(options, adjusting, model).solve()
    moved = fit_similarity(camera_centers(colmap_poses(work, model)), camera_centers(poses))
    moved.transform_model(model)
    off_m, off_deg = pose_error(colmap_poses(work, model), poses)
    print(f"f = {model.cameras[1].mean_focal_length():.1f} px; poses moved by {np.median(off_m):.3f} m and "
          f"{np.median(off_deg):.2f} degrees (medians), at most {off_m.max():.3f} m")  # fmt: skip
    (work / "map").mkdir(exist_ok=True)
    model.write_binary(str(work / "map"))


def full_map(args: argparse.Namespace) -> FullMap:
    """Map all photographs, or read what is in `--work`."""
    work, metric = args.work, True
    if args.poses and not holds_model(work / "map"):
        map_known_poses(args.poses, work, args.focal_px)
    images, side_px = work / "images" if args.poses else args.images, 0 if args.poses else args.max_side_px
    if not args.poses:
        settings = MapConfig(photographs=PhotographsConfig(images=images, max_side_px=side_px))
        metric = map_photographs(settings, work / "map", work / "photographs").scale.is_metric
    with Processes(1) as processes:
        features = photograph_features(images, work / "photographs", side_px, MAP.extractor, processes)
    model = read_model(work / "map")
    camera = only_camera(cameras_by_id(model.cameras, work / "map"), work / "map")

    def depths() -> dict[int, float]:
        found = {}
        for number, image in model.images.items():
            points = [model.points3D[seen.point3D_id].xyz for seen in image.points2D if seen.has_point3D()]
            if image.has_pose and points:
                found[number - 1] = float(np.median((image.cam_from_world() * np.array(points))[:, 2]))
        return found

    if not metric:
        Similarity(DEPTH_M / float(np.median(list(depths().values()))), np.eye(3), np.zeros(3)).transform_model(model)
    depth_m = depths()
    limit_m = {row: MAX_ERROR_M if metric else MAX_ERROR_OF_DEPTH * depth for row, depth in depth_m.items()}
    poses = {row: model.images[row + 1].cam_from_world().matrix() for row in sorted(depth_m)}
    database = work / "photographs" / "database.db"
    return FullMap(model, database, features.names, features.stored, camera, poses, limit_m)


def blocks(n: int, number: int, largest: float) -> list[tuple[int, int]]:
    """First and one past the last row of blocks among n, from a few rows to a share of all, spread over them."""
    sizes = np.rint(np.geomspace(max(2, n / 16), n * largest, number)).astype(int)
    starts = [round(((i + 1) * 0.6180339887) % 1 * (n - size)) for i, size in enumerate(sizes)]
    return [(start, start + int(size)) for start, size in zip(starts, sizes, strict=True)]


def without(full: FullMap, left_out: list[int], folder: Path) -> tuple[Landmarks, pd.DataFrame]:
    """The landmarks of a map without some photographs, and how these localize; from `folder`, if they are there."""
    if (folder / "labels.csv").is_file():
        return Landmarks.load(folder / "landmarks.npz"), pd.read_csv(folder / "labels.csv")
    rest = {row: pose for row, pose in full.poses.items() if row not in left_out}
    (camera,) = full.model.cameras.values()
    model = triangulate(posed_model(camera, full.names, rest, full.stored), full.database)
    worst_px = PhotographsConfig().max_reprojection_error_px
    landmarks = load_colmap_landmarks(folder, full.database, worst_px, reconstruction=model)
    localizer, labels = Localizer(landmarks, full.camera, extractor=MAP.extractor), []
    for row in left_out:
        pixels, descriptors = full.stored[row]  # as the extractor gave them, but for the rounding that matching does
        keypoints = Keypoints(
            pixels.astype(np.float32), descriptors / np.float32(512), np.ones(len(pixels), np.float32)
        )
        found = localizer.estimate(keypoints, *localizer.match([keypoints])[0])
        pose = np.full((3, 4), np.nan) if found.cam_from_world is None else found.cam_from_world
        error_m, error_deg = (float(error) for error in pose_error(pose, full.poses[row]))
        good = found.status == LOCALIZED and error_m < full.limit_m[row] and error_deg < MAX_ERROR_DEG
        about = {"row": row, "image": full.names[row], "status": found.status, "good": good, "error_m": error_m}
        about |= {"error_deg": error_deg, "limit_m": full.limit_m[row], "n_matches": found.n_matches}
        labels.append({**about, "n_inliers": len(found.inlier_rows), "n_landmarks": len(landmarks)})
    folder.mkdir(parents=True, exist_ok=True)
    landmarks.save(folder / "landmarks.npz")
    pd.DataFrame(labels).to_csv(folder / "labels.csv", index=False)
    return landmarks, pd.read_csv(folder / "labels.csv")


def score_blocks(full: FullMap, args: argparse.Namespace) -> pd.DataFrame:
    """Every photograph of every block, with its label and a column of scores for each method."""
    occlusion: OcclusionModel = HiddenPointRemoval(threads=1) if args.occlusion == "hidden-points" else NoOcclusion()
    rows, parts = list(full.poses), []
    for number, (first, last) in enumerate(
        tqdm(blocks(len(rows), args.blocks, args.largest), "leave out", unit="block")
    ):
        left_out = rows[first:last]
        landmarks, views = without(full, left_out, args.work / "blocks" / f"{first}-{last}")
        mapped = np.stack([pose for row, pose in full.poses.items() if row not in left_out]).astype(np.float32)
        reduced = LocalizationMap(landmarks, full.camera, occlusion, mapping_poses=mapped)
        looked = np.stack([full.poses[row] for row in left_out])
        for name in args.methods:
            needs = check_method(name).weights
            weights = args.weights / f"{needs}.safetensors" if needs else None
            scorer = make_scorer(name, reduced, weights=weights)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", OutOfRangeWarning)  # the table tells how many views are in range
                views[name], views[f"{name} in range"] = scorer.score(looked), scorer.in_range(looked)
        parts.append(views.assign(block=number))
    return pd.concat(parts, ignore_index=True)


SHARES = ("expected-inliers", "visible")  # methods that give a share of the map's landmarks


def auc(views: pd.DataFrame, method: str) -> float:
    """Area under the ROC curve; NaN where all views are of one class."""
    return float(roc_auc_score(views["good"], views[method])) if views["good"].nunique() == 2 else float("nan")


def summarize(scene: str, views: pd.DataFrame, methods: Iterable[str], resamples: int) -> pd.DataFrame:
    """The table: one row for each method. Shares of a map's landmarks are counted: blocks have maps of their own."""
    views = views.assign(**{name: views[name] * views["n_landmarks"] for name in methods if name in SHARES})
    rng, good = np.random.default_rng(0), views["good"].to_numpy(dtype=bool)
    of_block: list[NDArray[np.int64]] = [np.asarray(rows) for rows in views.groupby("block").indices.values()]
    draws = rng.integers(0, len(of_block), (resamples, len(of_block)))
    drawn = [views.iloc[np.concatenate([of_block[block] for block in draw])] for draw in draws]
    rows = []
    for name in methods:
        low, high = np.nanpercentile([auc(resample, name) for resample in drawn], PERCENTILES)
        row = {"scene": scene, "method": name, "views": len(views), "good": int(good.sum()), "blocks": len(of_block)}
        row |= {"auc": auc(views, name), "auc_low": float(low), "auc_high": float(high), "ece": float("nan")}
        row |= {"real_over_expected_good": float("nan"), "real_over_expected_all": float("nan")}
        row["in_range"] = float(views[f"{name} in range"].mean())
        if is_probability(name):
            row["ece"] = expected_calibration_error(views[name].to_numpy(), good)
        if name == EXPECTED:
            real, expected = views["n_inliers"].to_numpy() * good, views[name].to_numpy()
            row["real_over_expected_good"] = real.sum() / expected[good].sum()
            row["real_over_expected_all"] = real.sum() / expected.sum()
        rows.append(row)
    return pd.DataFrame(rows)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0],
        epilog=__doc__.partition("\n\n")[2],
        formatter_class=argparse.RawTextHelpFormatter,
    )
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--images", type=Path, help="folder of photographs, to be mapped from nothing else")
    source.add_argument("--poses", type=Path, help="folder of photographs, depth images and poses, as of 7-Scenes")
    parser.add_argument("--weights", type=Path, default=Path("data/release/weights"), help="folder of weights files")
    parser.add_argument("--methods", nargs="+", default=["set", EXPECTED, "bins", "visible"], help="what to compare")
    parser.add_argument("--occlusion", choices=("hidden-points", "none"), default="hidden-points")
    parser.add_argument("--blocks", type=int, default=12, help="number of blocks (default: %(default)s)")
    parser.add_argument("--largest", type=float, default=0.5, help="share in the largest block (default: %(default)s)")
    parser.add_argument("--max-side-px", type=int, default=1600, help="longer side of --images (default: %(default)s)")
    parser.add_argument("--focal-px", type=float, default=525.0, help="first guess for --poses (default: %(default)s)")
    parser.add_argument("--resamples", type=int, default=1000, help="of the blocks (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="write the table to this CSV file")
    parser.add_argument("--work", type=Path, help="keep maps and labels in this folder; default: a temporary one")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        args.work, start = args.work or Path(name), time.perf_counter()
        full = full_map(args)
        mapped = time.perf_counter()
        print(f"{len(full.poses)} of {len(full.names)} photographs, {full.model.num_points3D():,} landmarks, "
              f"{mapped - start:.0f} s")  # fmt: skip
        views = score_blocks(full, args)
        views.to_csv(args.work / "views.csv", index=False)
    shares = views.groupby("block").agg(views=("good", "size"), good=("good", "sum"), landmarks=("n_landmarks", "max"))
    table = summarize((args.poses or args.images).resolve().name, views, args.methods, args.resamples)
    print(f"blocks scored in {time.perf_counter() - mapped:.0f} s\n{shares.to_string()}\n")
    print(table.to_string(index=False, float_format="{:.3f}".format))
    if args.out:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        table.to_csv(args.out, index=False)


if __name__ == "__main__":
    main()
