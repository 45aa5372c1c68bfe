"""How long keypoints of an image take: OpenCV's and COLMAP's SIFT on the CPU, `WarpSift` on a device.

    python tests/benchmarks/bench_extraction.py
    python tests/benchmarks/bench_extraction.py --device cuda --batch 16 --processes 16 --out h200.json
    python tests/benchmarks/bench_extraction.py --images frames.npz --methods opencv,warp --device cuda

Images are rendered in a generated apartment (or --scene) at 640 x 480, or read from an NPZ with an array `im`
(N, 480, 640, 3) uint8. CPU methods get RGB, as they do when labelling, one image at a time on one core, and again
spread over --processes processes. `warp` gets grey images in NumPy, --batch at a time, and returns NumPy. Times are
wall clock after a first image or batch; over processes there is one time for all. Also counted: how many of OpenCV's
keypoints `warp` finds within 0.1 px and 2 % in scale. Nothing here fails on time.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import bench_scenes
import numpy as np
from numpy.typing import NDArray
from tqdm.auto import tqdm

from wheretolook.features.config import ExtractorConfig
from wheretolook.features.extraction import KeypointExtractor
from wheretolook.features.keypoints import Keypoints

METHODS = ("opencv", "colmap", "warp")


def rendered(args: argparse.Namespace) -> NDArray[np.uint8]:
    """Views (N, 480, 640, 3) from anywhere in the scene."""
    from wheretolook.dataset.viewpoint_table import poses
    from wheretolook.geometry.camera import PinholeCamera
    from wheretolook.rendering.warp_renderer import WarpRenderer

    with tempfile.TemporaryDirectory() as name:
        scene = bench_scenes.open_scene(args.scene, Path(name), args.seed, args.device)
        table = bench_scenes.viewpoints_anywhere(scene, args.views, args.seed)
        return WarpRenderer(scene.mesh, args.device).render(PinholeCamera(), poses(table)).rgb


def time_on_cpu(
    config: ExtractorConfig, images: NDArray[np.uint8], processes: int
) -> tuple[dict[str, Any], list[Keypoints]]:
    """Milliseconds an image on one core and over processes, and the keypoints."""
    extractor = KeypointExtractor(config)
    extractor.extract(images[0])
    found = []
    times = []
    for rgb in tqdm(images, config.method, unit="image"):
        start = time.perf_counter()
        found.append(extractor.extract(rgb))
        times.append(1e3 * (time.perf_counter() - start))
    report: dict[str, Any] = {"ms_an_image": bench_scenes.spread(times)}
    if processes > 1:
        # long enough that the start of the processes can be told from their work
        repeats = -(-20 * processes // len(images))
        spread_out = extractor.extract_many((rgb for _ in range(repeats) for rgb in images), processes)
        for _ in range(4 * processes):
            next(spread_out)
        start = time.perf_counter()
        rest = sum(1 for _ in spread_out)
        report |= {"processes": processes, "ms_an_image_over_processes": 1e3 * (time.perf_counter() - start) / rest}
    return report, found


def time_on_device(
    config: ExtractorConfig, images: NDArray[np.uint8], device: str, batch: int, repeats: int
) -> tuple[dict[str, Any], list[Keypoints]]:
    """Milliseconds an image in batches, and the keypoints."""
    from wheretolook.features.warp_sift import WarpSift

    extractor = WarpSift(config, device)
    # Rec. 709 and rounded, as COLMAP's own conversion
    grey = np.rint(images @ (0.2126, 0.7152, 0.0722)).astype(np.uint8)
    batches = [grey[start : start + batch] for start in range(0, len(grey), batch)]
    extractor.extract_many(batches[0])
    first: list[Keypoints] = []
    times = []
    same = True
    for repeat in tqdm(range(repeats), "warp", unit="repeat"):
        found: list[Keypoints] = []
        for part in batches:
            start = time.perf_counter()
            found += extractor.extract_many(part)
            times.append(1e3 * (time.perf_counter() - start) / len(part))
        if repeat == 0:
            first = found
        same &= all(a.descriptors.tobytes() == b.descriptors.tobytes() for a, b in zip(first, found, strict=True))
    return {"device": device, "batch": batch, "ms_an_image": bench_scenes.spread(times), "same_every_time": same}, first


def share_found(theirs: list[Keypoints], ours: list[Keypoints]) -> float:
    """Share of keypoints that have another within 0.1 px and 2 % in scale."""
    from scipy.spatial import KDTree

    found = total = 0
    for a, b in zip(theirs, ours, strict=True):
        total += len(a)
        if len(a) and len(b):
            near = KDTree(b.pixels).query_ball_point(a.pixels, 0.1)
            found += sum(
                bool((np.abs(b.scales_px[rows] / scale - 1) < 0.02).any())
                for rows, scale in zip(near, a.scales_px, strict=True)
            )
    return found / total if total else float("nan")


def print_report(report: dict[str, dict[str, Any]]) -> None:
    """One row a method."""
    print(f"\n{'':10}{'ms an image':28}{'keypoints an image':26}over processes")
    for name, one in report.items():
        everywhere = one.get("ms_an_image_over_processes")
        print(
            f"{name:10}{bench_scenes.format_spread(one['ms_an_image'], 2):28}"
            f"{bench_scenes.format_spread(one['keypoints'], 0):26}"
            + (f"{everywhere:.2f} ms an image over {one['processes']}" if everywhere else "")
        )
    if "opencv_found" in report.get("warp", {}):
        print(f"warp finds {report['warp']['opencv_found']:.2%} of OpenCV's keypoints")
    if not report.get("warp", {}).get("same_every_time", True):
        print("warp did not give the same every time")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=Path, help="NPZ with an array `im` (N, H, W, 3) uint8; default: render")
    parser.add_argument("--scene", type=Path, help="folder with a mesh.glb, or a mesh file; default: an apartment")
    parser.add_argument("--views", type=int, default=48, help="images at most (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the apartment and the views (default: %(default)s)")
    parser.add_argument("--methods", default=",".join(METHODS), help="of these (default: %(default)s)")
    parser.add_argument("--device", default="cpu", help="of `warp` and of rendering (default: %(default)s)")
    parser.add_argument("--batch", type=int, default=8, help="images of `warp` at a time (default: %(default)s)")
    parser.add_argument("--repeats", type=int, default=3, help="of `warp` (default: %(default)s)")
    parser.add_argument("--processes", type=int, default=1, help="for the CPU methods (default: %(default)s)")
    parser.add_argument("--max-keypoints", type=int, default=2048, help="of an image (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="write all numbers to this JSON file")
    args = parser.parse_args()
    methods = args.methods.split(",")
    if not set(methods) <= set(METHODS):
        parser.error(f"--methods are of {', '.join(METHODS)}")
    bench_scenes.use_one_thread()

    if args.images is not None:
        with np.load(args.images) as stored:
            images = stored["im"][: args.views]
    else:
        images = rendered(args)
    report: dict[str, dict[str, Any]] = {}
    found: dict[str, list[Keypoints]] = {}
    for method in methods:
        if method == "warp":
            config = ExtractorConfig(max_keypoints=args.max_keypoints)
            report[method], found[method] = time_on_device(config, images, args.device, args.batch, args.repeats)
        else:
            config = ExtractorConfig(method, max_keypoints=args.max_keypoints)
            report[method], found[method] = time_on_cpu(config, images, args.processes)
        report[method]["keypoints"] = bench_scenes.spread([len(one) for one in found[method]])
    if {"warp", "opencv"} <= set(methods):
        report["warp"]["opencv_found"] = share_found(found["opencv"], found["warp"])
    print_report(report)
    settings = {name: str(value) if isinstance(value, Path) else value for name, value in vars(args).items()}
    bench_scenes.write_report(args.out, {"settings": settings, "methods": report})


if __name__ == "__main__":
    main()
