"""How long poses take, and how far labels agree, by PoseLib as the localizer uses it and by pycolmap as it did before.

    python tests/benchmarks/bench_poses.py
    python tests/benchmarks/bench_poses.py --scene data/demo/apartment-000 --views 300 --seeds 3 --out poses.json

Of a dataset's scene that has a map and viewpoints, these are used (a random choice of the viewpoints); another scene
(by default a generated apartment) is mapped, and viewpoints lie anywhere in it. Views are rendered, extracted and
matched once, and all estimators get the same matches. Their times are CPU times of one thread, and leave out what other
processes took of the core. Agreement is with pycolmap at the first seed; its other seeds tell how much of a
disagreement is chance. pycolmap has the settings of earlier versions: confidence 0.99999 and three times the trials
that it asks for. Nothing here fails on time.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import bench_scenes
import numpy as np
import pycolmap
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_table import LOCALIZED, NO_POSE, TOO_FEW_MATCHES, poses
from wheretolook.features.keypoints import Keypoints
from wheretolook.features.matching import Matches
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import Float, pose_error
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.localizer import Localization, Localizer
from wheretolook.localization.shard import BATCH
from wheretolook.mapping.config import MapConfig
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.rendered_map import build_map
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh

Estimate = Callable[[Keypoints, NDArray[np.int64], NDArray[np.int64]], Localization]

MAX_ERROR_M = 0.05
MAX_ERROR_DEG = 0.4
RATIOS = (0, 0.1, 0.15, 0.25, 0.5, 1)  # inliers over matches, between which times are shown


def by_pycolmap(landmarks: Landmarks, camera: PinholeCamera, config: LocalizerConfig) -> Estimate:
    """The localizer's third step as it was: COLMAP's LO-RANSAC, and refinement with a Cauchy loss of one pixel."""
    params = [camera.focal_px, camera.cx, camera.cy]
    colmap_camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=camera.width, height=camera.height, params=params)
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error = config.max_error_px
    estimation.ransac.random_seed = config.seed
    options = colmap_camera, estimation, pycolmap.AbsolutePoseRefinementOptions()

    def estimate(keypoints: Keypoints, of_image: NDArray[np.int64], of_map: NDArray[np.int64]) -> Localization:
        if len(of_map) < config.min_matches:
            return Localization(TOO_FEW_MATCHES, None, len(of_map), matched_rows=of_map)
        pixels = keypoints.pixels[of_image].astype(np.float64)
        points = landmarks.points[of_map]
        found = pycolmap.estimate_and_refine_absolute_pose(pixels, points, *options)
        if found is None:
            return Localization(NO_POSE, None, len(of_map), matched_rows=of_map)
        status = LOCALIZED if found["num_inliers"] >= config.min_inliers else NO_POSE
        rows = of_map[np.asarray(found["inlier_mask"], dtype=bool)]
        return Localization(status, found["cam_from_world"].matrix(), len(of_map), rows, of_map)

    return estimate


def prepare(args: argparse.Namespace, folder: Path) -> tuple[Path, Path, PinholeCamera, Float]:
    """Files of a mesh and its landmarks, the camera, and the viewpoints' poses (B, 3, 4)."""
    if args.scene and (args.scene / "map" / "landmarks.npz").is_file():
        dataset = Dataset.load(args.scene.parent)
        files = next(files for files in dataset.scenes if files.name == args.scene.name)
        table = files.read_table()
        chosen = table.sample(min(args.views, len(table)), random_state=args.seed)
        return files.mesh, files.landmarks, dataset.camera, poses(chosen)
    camera = PinholeCamera()
    scene = bench_scenes.open_scene(args.scene, folder, args.seed, args.device)
    inputs = scene.mesh, WarpRenderer(scene.mesh, args.device), scene.free_space, camera
    build_map(*inputs, MapConfig(n_images=args.map_images), args.seed, folder / "map", workers=1)
    viewpoints = bench_scenes.viewpoints_anywhere(scene, args.views, args.seed)
    return scene.file, folder / "map" / "landmarks.npz", camera, poses(viewpoints)


def matched(
    mesh: Path, localizer: Localizer, camera: PinholeCamera, true_poses: Float, device: str
) -> tuple[list[tuple[Keypoints, Matches]], dict[str, list[float]]]:
    """Keypoints and matches of every view, and the CPU milliseconds a view of each step, by batch."""
    renderer = WarpRenderer(load_mesh(mesh), device)
    found = []
    times: dict[str, list[float]] = {"render": [], "extract": [], "match": []}
    for start in tqdm(range(0, len(true_poses), BATCH), "match", unit="batch"):
        batch = true_poses[start : start + BATCH]
        clock = [time.process_time()]
        images = renderer.render(camera, batch).rgb
        clock.append(time.process_time())
        keypoints = localizer.extract(images)
        clock.append(time.process_time())
        matches = localizer.match(keypoints)
        clock.append(time.process_time())
        found += list(zip(keypoints, matches, strict=True))
        for step, seconds in zip(times.values(), np.diff(clock), strict=True):
            step.append(1e3 * seconds / len(batch))
    return found, times


def run(estimate: Estimate, views: list[tuple[Keypoints, Matches]], true_poses: Float) -> dict[str, NDArray[Any]]:
    """Of each view: CPU milliseconds, inliers, status, and whether it localizes, and does so within the limits."""
    seconds = []
    results = []
    for keypoints, matches in views:
        start = time.thread_time()
        results.append(estimate(keypoints, *matches))
        seconds.append(time.thread_time() - start)
    none: Float = np.full((3, 4), np.nan)
    error_m, error_deg = pose_error(
        np.stack([none if one.cam_from_world is None else one.cam_from_world for one in results]), true_poses
    )
    localized = np.array([one.status == LOCALIZED for one in results])
    return {
        "ms": 1e3 * np.array(seconds),
        "inliers": np.array([len(one.inlier_rows) for one in results]),
        "status": np.array([one.status for one in results]),
        "localized": localized,
        "good": localized & (error_m < MAX_ERROR_M) & (error_deg < MAX_ERROR_DEG),
    }


def report_on(name: str, found: dict[str, NDArray[Any]], reference: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Print and return the times of an estimator and how far it agrees with the reference."""
    ms = found["ms"]
    good = found["good"]
    expected = reference["good"]
    report = {
        "mean_ms": float(ms.mean()),
        "ms": bench_scenes.spread(ms),
        "localized": int(found["localized"].sum()),
        "good": int(good.sum()),
        "wrong": int((found["localized"] & ~good).sum()),
        "same_status": float((found["status"] == reference["status"]).mean()),
        "same_good": float((good == expected).mean()),
        "good_gained": int((good & ~expected).sum()),
        "good_lost": int((expected & ~good).sum()),
    }
    print(
        f"{name:18}{report['mean_ms']:8.2f}  {bench_scenes.format_spread(report['ms']):24}{report['localized']:9,}"
        f"{report['good']:7,}{report['wrong']:7,}{report['same_status']:9.2%}{report['same_good']:9.2%}"
        f"  +{report['good_gained']} -{report['good_lost']}"
    )
    return report


def main() -> None:
    parser = bench_scenes.argument_parser(__doc__, views=200)
    parser.add_argument("--seeds", type=int, default=2, help="seeds of RANSAC to compare (default: %(default)s)")
    args = parser.parse_args()
    bench_scenes.use_one_thread()
    with tempfile.TemporaryDirectory() as name:
        mesh, path, camera, true_poses = prepare(args, Path(name))
        landmarks = Landmarks.load(path)
        configs = [replace(LocalizerConfig(), seed=seed) for seed in range(args.seeds)]
        localizers = [Localizer(landmarks, camera, config, device=args.device) for config in configs]
        views, steps = matched(mesh, localizers[0], camera, true_poses, args.device)
    n_matches = np.array([len(of_map) for _, (_, of_map) in views])

    print(f"\n{len(views)} views, {len(landmarks):,} landmarks; matches a view: ", end="")
    print(bench_scenes.format_spread(bench_scenes.spread(n_matches), 0))
    for step, times in steps.items():
        print(f"  {step:8}{bench_scenes.format_spread(bench_scenes.spread(times))} CPU ms a view")
    print(f"\n{'':18}{'mean ms':>8}  {'median ms (p10 to p90)':24}{'localized':>9}{'good':>7}{'wrong':>7}"
          f"{'status =':>9}{'good =':>9}")  # fmt: skip
    sides = [(f"pycolmap, seed {config.seed}", by_pycolmap(landmarks, camera, config)) for config in configs]
    sides += [(f"PoseLib, seed {one.config.seed}", one.estimate) for one in localizers]
    results = {name: run(estimate, views, true_poses) for name, estimate in sides}
    before = results["pycolmap, seed 0"]
    now = results["PoseLib, seed 0"]
    compared = {name: report_on(name, found, before) for name, found in results.items()}
    print(f"PoseLib takes {before['ms'].sum() / now['ms'].sum():.1f} times less; by pycolmap's share of inliers:")
    ratio = before["inliers"] / np.maximum(n_matches, 1)
    for low, high in pairwise(RATIOS):
        among = (n_matches >= 4) & (ratio >= low) & ((ratio < high) | (high == 1))
        if among.any():
            means = before["ms"][among].mean(), now["ms"][among].mean()
            print(f"  {low:4.0%} to {high:4.0%}: {among.sum():5} views, {means[0]:7.1f} and {means[1]:6.1f} ms")
    settings = {name: str(value) if isinstance(value, Path) else value for name, value in vars(args).items()}
    steps_ms = {step: bench_scenes.spread(times) for step, times in steps.items()}
    bench_scenes.write_report(args.out, {"settings": settings, "steps_ms": steps_ms, "estimators": compared})


if __name__ == "__main__":
    main()
