"""Measure how well methods rank real photographs: map them, or take known poses, then run `wheretolook check`.

    python -m wheretolook_paper.studies.photographs --images fox --work work/fox --out photographs.csv
    python -m wheretolook_paper.studies.photographs --poses kitchen --work work/kitchen --out photographs.csv
    python -m wheretolook_paper.studies.photographs --poses kitchen --work work/aliked --extractor aliked=FILE.pth

Photographs are mapped as by `wheretolook map --images`, or from poses in the layout of 7-Scenes (frame-*.color.*,
.depth.png, .pose.txt with world_from_cam in metres). These poses choose the image pairs and the first triangulation;
bundle adjustment then refines them and the focal length, and the result is aligned to them.

The table has, for each method, the AUC over all held-out photographs and within blocks, and the regret, with 95 %
intervals by resampling blocks; for the first method also the calibration error and real over expected inliers. `--out`
keeps the rows of other scenes, and those of adapted weights; the first method at other accuracies is written beside it.
`--work` caches maps and blocks. `wheretolook adapt` measures adapted weights.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pycolmap
from jsonargparse import auto_cli
from sklearn.metrics import roc_auc_score
from tqdm.auto import tqdm

from wheretolook.evaluation.statistics import expected_calibration_error
from wheretolook.features.extractor import ExtractorConfig
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import Float, camera_centers, invert_poses, pose_error
from wheretolook.holdout.photo_map import open_map
from wheretolook.holdout.report import CheckReport, check_map
from wheretolook.holdout.scores import Scoring
from wheretolook.mapping.colmap_model import colmap_poses, holds_model
from wheretolook.mapping.config import MIN_TRIANGULATION_ANGLE_DEG, FrameOptions, MapConfig, PhotographsConfig
from wheretolook.mapping.depth_images import read_depth
from wheretolook.mapping.georeference import fit_similarity
from wheretolook.mapping.map_folder import MapRun
from wheretolook.mapping.photograph_map import map_photographs, photograph_features
from wheretolook.mapping.photographs import SUFFIXES
from wheretolook.mapping.triangulation import (
    Stored,
    choose_pairs,
    fill_database,
    match_pairs,
    shrink_depth,
    surface_overlap,
    write_matches,
)
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.processes import WorkerPool
from wheretolook.utils.texts import quiet_colmap
from wheretolook_paper.evaluation.comparison import replace_rows

FOCAL_PX = 525.0  # initial focal length of photographs with poses
PARTNERS = 20  # that each photograph with a pose is matched with
MAP = MapConfig()
ACCURACIES_CSV = "photograph_accuracies.csv"
ACCURACIES = (0.25, 2.0), (0.5, 5.0)  # metres and degrees, beside that of the weights


def posed_model(camera: Any, names: list[str], poses: Mapping[int, Float], stored: list[Stored]) -> Any:
    """Return a reconstruction of photographs with keypoints and poses (3, 4) by row, without points."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    for row, pose in poses.items():
        image = pycolmap.Image(name=names[row], camera_id=camera.camera_id, image_id=row + 1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in stored[row][0].astype(float)])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3]))
    return model


def triangulate(model: Any, database: Path) -> Any:
    """Triangulate a model with fixed poses from the matches in a database."""
    options = pycolmap.IncrementalPipelineOptions(random_seed=0, num_threads=1, extract_colors=False)
    options.image_names = [image.name for image in model.images.values()]
    options.triangulation.random_seed = options.mapper.random_seed = 0
    options.triangulation.ignore_two_view_tracks = not MAP.two_view_landmarks
    options.triangulation.min_angle = options.mapper.filter_min_tri_angle = MIN_TRIANGULATION_ANGLE_DEG
    with tempfile.TemporaryDirectory() as folder, quiet_colmap("ERROR"):
        model = pycolmap.triangulate_points(model, str(database), folder, folder, options=options)
    model.update_point_3d_errors()
    return model


def map_known_poses(folder: Path, work: Path, extractor: ExtractorConfig, workers: int) -> None:
    """Map photographs in the layout of 7-Scenes into `work/map`, aligned to their poses."""
    colors = sorted(path for path in folder.glob("*.color.*") if path.suffix in SUFFIXES)
    for name in ("images", "photographs"):
        (work / name).mkdir(parents=True, exist_ok=True)
    for path in colors:
        if not (work / "images" / path.name).exists():
            (work / "images" / path.name).symlink_to(path.resolve())
    stems = [path.name.partition(".color.")[0] for path in colors]
    poses = invert_poses(np.stack([np.loadtxt(folder / f"{stem}.pose.txt")[:3] for stem in stems]))
    depth_m = np.stack([shrink_depth(read_depth(folder / f"{stem}.depth.png")) for stem in stems])
    with WorkerPool(workers) as processes:
        config = PhotographsConfig(extractor=extractor)
        run = MapRun(config, processes)
        features = photograph_features(work / "images", work / "photographs", run, max_side_px=0)
        names = features.names
        stored = features.stored
        pinhole = PinholeCamera(int(features.sizes[0][0]), int(features.sizes[0][1]), FOCAL_PX)
        pairs = choose_pairs(surface_overlap(pinhole, poses, depth_m), PARTNERS)
        camera = pycolmap.Camera(camera_id=1, **pinhole.colmap.record())
        model = posed_model(camera, names, dict(enumerate(poses)), stored)
        database = work / "photographs" / "database.db"
        database.unlink(missing_ok=True)
        fill_database(database, model, stored, features.kind)
        found = match_pairs(stored, pairs, work, processes, kind=features.kind)
        write_matches(database, pairs, found, sorted(model.images))
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.function_tolerance = 1e-6
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    with quiet_colmap("ERROR"):
        matcher = pycolmap.GeometricVerifierOptions(num_threads=1)
        pycolmap.geometric_verification(str(database), matcher, two_view_geometry_options=verification)
        for _ in tqdm(range(3), "map: adjust", unit="round"):  # of triangulation and bundle adjustment
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


def rows_of(scene: str, numbers: Mapping[str, Any], method: str) -> list[dict[str, Any]]:
    """Return a row for each method; that of `method` has all numbers of a check."""
    rows = []
    for name, found in numbers["methods"].items():
        row = {"scene": scene, "method": name, "views": numbers["n_views"], "good": numbers["n_localized"]}
        row["blocks"] = numbers["n_blocks"]
        for column in ("auc", "auc_above_visible", "auc_within_blocks", "regret"):
            row |= _ends(column, found[column])
        if name == method:
            ratios = numbers["inliers_found_over_expected"] or {}
            row |= _ends("ece", numbers["ece"] or {}) | {"predicted": numbers["mean_probability"]}
            row |= {f"real_over_expected_{which}": ratio["value"] for which, ratio in ratios.items()}
            row["in_range"] = numbers["share_in_range"]
        rows.append(row)
    return rows


def accuracy_row(result: CheckReport, other: CheckReport) -> dict[str, Any]:
    """Return measures at another accuracy, and of the probabilities of `result` judged by the labels of this accuracy."""
    good = other.views["good"].to_numpy(bool)
    row = {"max_error_m": other.accuracy[0], "max_error_deg": other.accuracy[1], "views": len(good), "good": good.sum()}
    for end, views in (("", other.views), ("_of_weights", result.views)):
        row[f"auc{end}"] = roc_auc_score(good, views["score"])
        row[f"ece{end}"] = expected_calibration_error(views["score"].to_numpy(), good)
    return row


def _ends(column: str, measured: Mapping[str, Any]) -> dict[str, Any]:
    ends = {"": "value", "_low": "low", "_high": "high"}
    return {column + end: measured.get(key) for end, key in ends.items()}


def main(
    work: Path,
    images: Path | None = None,
    poses: Path | None = None,
    extractor: str = "opencv",
    weights: Path | None = None,
    also: tuple[str, ...] = ("expected-inliers", "bins"),
    workers: int = 1,
    out: Path | None = None,
) -> None:
    """Map the photographs, check the map, and write the table.

    Args:
        work: folder of maps and blocks.
        images: folder of photographs to map.
        poses: instead, a folder of photographs, depth images and poses, as of 7-Scenes.
        extractor: features of the map, NAME or NAME=WEIGHTS.
        weights: file or folder of weights, by default the bundled ones.
        also: other methods to compare.
        workers: worker processes.
        out: CSV file of the table.
    """
    source = poses or images
    if source is None:
        raise ConfigError("photographs are needed: --images or --poses")
    method, _, network = extractor.partition("=")
    features = ExtractorConfig(method, weights=network)
    model = work / "map"
    if not holds_model(model):
        if poses is not None:
            map_known_poses(poses, work, features, workers)
        else:
            settings = PhotographsConfig(images, extractor=features)
            map_photographs(settings, model, work / "photographs", workers=workers)
    scene = source.resolve().name
    photo_map = open_map(
        model, work / "photographs" / "database.db", scene, FrameOptions(scale=1 if poses is not None else None)
    )
    scoring = Scoring(weights=weights, also=also)
    result = check_map(photo_map, work / "check" / "work", scoring, workers=workers)
    result.save(work / "check")
    print("\n".join(result.lines()))
    rows = pd.DataFrame(rows_of(scene, result.numbers, result.method))
    print(rows.to_string(index=False, float_format="{:.3f}".format))
    by_limits = pd.DataFrame([
        {"scene": scene, **accuracy_row(result, check_map(photo_map, work / "check" / "work", at, workers=workers))}
        for at in (replace(scoring, also=(), accuracy=accuracy) for accuracy in ACCURACIES)
    ])  # fmt: skip
    print(by_limits.to_string(index=False, float_format="{:.3f}".format))
    if out is not None:
        replace_rows(out, rows, ["scene", "method"], "%.4g")
        replace_rows(out.with_name(ACCURACIES_CSV), by_limits, ["scene", "max_error_m"], "%.4g")


if __name__ == "__main__":
    auto_cli(main, as_positional=False)
