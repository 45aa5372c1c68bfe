"""How far labels depend on the extractor: a map by each along the same walk, the same viewpoints labelled in each.

    python tests/benchmarks/bench_extractors.py
    python tests/benchmarks/bench_extractors.py --scene FOLDER --views 1000 --out extractors.json

The extractors are OpenCV's SIFT (the default), COLMAP's own on the CPU, and COLMAP's without the doubled first octave.
The extractor of a map is also that of its queries. Viewpoints are at random free locations and look in directions all
over the sphere, whatever the maps have seen. Labels are the paper's (5 cm, 0.4 degrees). Extraction is timed on one
thread, the extractors in turn on each image; labelling runs on all cores and includes rendering.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import asdict
from itertools import combinations
from pathlib import Path
from typing import Any

import bench_scenes
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.dataset.viewpoint_table import LOCALIZED, is_good, poses
from wheretolook.features.config import ExtractorConfig
from wheretolook.features.extraction import KeypointExtractor
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.localization.config import LabelConfig
from wheretolook.localization.labeller import LabelTask, label_scenes
from wheretolook.localization.shard import SceneJob
from wheretolook.mapping.config import MapConfig
from wheretolook.mapping.rendered_map import build_map
from wheretolook.rendering.warp_renderer import WarpRenderer

EXTRACTORS = {
    "opencv": ExtractorConfig("opencv"),
    "colmap": ExtractorConfig("colmap"),
    "colmap, first_octave=0": ExtractorConfig("colmap", first_octave=0),
}


def time_extraction(
    scene: bench_scenes.Scene, camera: PinholeCamera, cam_from_world: NDArray[np.floating[Any]], device: str
) -> dict[str, dict[str, dict[str, float]]]:
    """CPU seconds and keypoints an image, by extractor."""
    renderer = WarpRenderer(scene.mesh, device)
    extractors = {name: KeypointExtractor(config) for name, config in EXTRACTORS.items()}
    seconds: dict[str, list[float]] = {name: [] for name in EXTRACTORS}
    keypoints: dict[str, list[int]] = {name: [] for name in EXTRACTORS}
    for pose in tqdm(cam_from_world, "time extraction", unit="view"):
        rgb = renderer.render(camera, pose[None]).rgb[0]
        for name, extractor in extractors.items():
            start = time.process_time()  # on one thread, and whatever else the machine does
            found = extractor.extract(rgb)
            seconds[name].append(time.process_time() - start)
            keypoints[name].append(len(found))
    return {
        name: {"seconds": bench_scenes.spread(seconds[name][1:]), "keypoints": bench_scenes.spread(keypoints[name])}
        for name in EXTRACTORS
    }


def label_with(
    config: ExtractorConfig, scene: bench_scenes.Scene, camera: PinholeCamera, table: pd.DataFrame,
    folder: Path, args: argparse.Namespace,
) -> tuple[pd.DataFrame, dict[str, Any]]:  # fmt: skip
    """Map the scene with one extractor and label the viewpoints in that map."""
    report = build_map(
        scene.mesh,
        WarpRenderer(scene.mesh, args.device),
        scene.free_space,
        camera,
        MapConfig(n_images=args.map_images, extractor=config),
        args.seed,
        folder / "map",
    )
    start = time.perf_counter()
    landmarks = folder / "map" / "landmarks.npz"
    job = SceneJob(scene.file, landmarks, camera, extractor=config, device=args.device)
    (labelled,) = label_scenes([LabelTask("scene", job, table, folder / "shards")], LabelConfig())
    return labelled.table, {
        "n_landmarks": report.n_landmarks,
        "median_track_length": report.median_track_length,
        "landmark_to_mesh_cm": report.median_distance_to_mesh_cm,
        "map_s": report.seconds["total"],
        "label_views_per_s": len(table) / (time.perf_counter() - start),
    }


def describe(labelled: pd.DataFrame) -> dict[str, Any]:
    """Positives and errors of one set of labels."""
    good = is_good(labelled)
    return {
        "localized": int((labelled["status"] == LOCALIZED).sum()),
        "positives": int(good.sum()),
        "error_m_where_good": bench_scenes.spread(labelled.loc[good, "error_m"]),
        "error_deg_where_good": bench_scenes.spread(labelled.loc[good, "error_deg"]),
    }


def print_report(extractors: dict[str, dict[str, Any]], agreements: list[dict[str, Any]], views: int) -> None:
    """Two tables: one row an extractor, one row a pair of them."""
    print(f"\n{'':24}{'landmarks':>10}{'localized':>11}{'good':>8}{'views/s':>9}   "
          f"{'CPU ms an image':26}{'keypoints an image':24}cm where good")  # fmt: skip
    for name, one in extractors.items():
        print(
            f"{name:24}{one['n_landmarks']:10,}{one['localized'] / views:11.1%}{one['positives'] / views:8.1%}"
            f"{one['label_views_per_s']:9.2f}   {bench_scenes.format_spread(one['seconds'], 0, 1e3):26}"
            f"{bench_scenes.format_spread(one['keypoints'], 0):24}"
            f"{bench_scenes.format_spread(one['error_m_where_good'], 2, 100)}"
        )
    print(f"\n{'labels of':44}{'equal':>8}{'kappa':>8}{'both':>7}{'first':>7}{'second':>8}{'neither':>9}")
    for one in agreements:
        print(
            f"{one['first'] + ' / ' + one['second']:44}{one['equal']:8.1%}{one['kappa']:8.3f}{one['both']:7}"
            f"{one['only_first']:7}{one['only_second']:8}{one['neither']:9}"
        )


def main() -> None:
    parser = bench_scenes.argument_parser(__doc__, views=1000)
    parser.add_argument(
        "--timed", type=int, default=200, help="viewpoints whose extraction is timed (default: %(default)s)"
    )
    args = parser.parse_args()
    bench_scenes.use_one_thread()

    camera = PinholeCamera()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = bench_scenes.open_scene(args.scene, folder, args.seed, args.device)
        table = bench_scenes.viewpoints_anywhere(scene, args.views, args.seed)
        extractors: dict[str, dict[str, Any]] = time_extraction(
            scene, camera, poses(table.head(args.timed)), args.device
        )
        labels = {}
        for index, (extractor, config) in enumerate(EXTRACTORS.items()):
            print(f"{extractor}:")
            labelled, made = label_with(config, scene, camera, table, folder / str(index), args)
            extractors[extractor] |= {"config": asdict(config), **made, **describe(labelled)}
            labels[extractor] = is_good(labelled)
    agreements = [
        {"first": a, "second": b, **bench_scenes.agreement(labels[a], labels[b])} for a, b in combinations(labels, 2)
    ]
    print_report(extractors, agreements, args.views)
    settings = {name: str(value) if isinstance(value, Path) else value for name, value in vars(args).items()}
    bench_scenes.write_report(args.out, {"settings": settings, "extractors": extractors, "agreement": agreements})


if __name__ == "__main__":
    main()
