"""Measure how a scorer trained with SIFT ranks views of maps by other features: one map and labels per extractor.

    python tests/benchmarks/bench_features.py --work FOLDER --features opencv aliked=aliked-n16rot.pth xfeat=xfeat.pt
    python tests/benchmarks/bench_features.py --work FOLDER ... --scenes 1 2 --locations 60 --directions 12

Each scene is an apartment generated from its seed. All extractors map it along the same walk and localize the same
random views. Keypoints are cached in --work, so that an interrupted run resumes. The table has, for each extractor, the
share of views localized within 5 cm and 0.4 degrees, and the AUC and regret (in percentage points, over locations with
a view that localizes) of the bundled scorer, of the scorer without the landmarks' ambiguity, and of `bins`, with 95 %
bootstrap intervals over locations.
"""

import time
from dataclasses import replace

import numpy as np
from common import free_points, open_scene, options, use_one_thread
from sklearn.metrics import roc_auc_score
from tqdm.auto import tqdm

from wheretolook.dataset.viewpoint_table import LOCALIZED
from wheretolook.features.extractor import ExtractorConfig, KeypointExtractor, Keypoints
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import pose_error, poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.localization.localizer import Localizer
from wheretolook.mapping.config import MapConfig
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map import Map
from wheretolook.mapping.rendered_map import build_map
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scorers.registry import make_scorer
from wheretolook.scorers.weights import load_scorer
from wheretolook.utils.files import load_npz, save_npz
from wheretolook.visibility.occlusion import MeshOcclusion

CAMERA = PinholeCamera()


def random_views(scene, locations, directions, seed):
    """Return poses (locations x directions, 3, 4) at free locations 0.8 to 2 m high, with yaws all around."""
    rng = np.random.default_rng(seed)
    low, high = scene.mesh.bounds
    bounds = np.array([(*low[:2], 0.8), (*high[:2], 2.0)])
    positions = free_points(scene.free_space, bounds, locations, rng)
    yaw = rng.uniform(0, 2 * np.pi, (locations, 1)) + 2 * np.pi * np.arange(directions) / directions
    pitch = rng.uniform(-0.5, 0.5, (locations, directions))
    ahead = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=-1)
    return poses_looking_along(np.repeat(positions, directions, axis=0), ahead.reshape(-1, 3))


def keypoints_of(poses, scene, extractor, folder, device):
    """Return keypoints of views (B, 3, 4), cached in a folder, and the CPU seconds of each extraction."""
    renderer = None
    keypoints = []
    seconds = []
    for row, pose in enumerate(tqdm(poses, f"{extractor.config.method}: extract", unit="view")):
        path = folder / f"{row:05}.npz"
        if not path.is_file():
            renderer = renderer or WarpRenderer(scene.mesh, device)
            rgb = renderer.render(CAMERA, pose[None]).rgb[0]
            start = time.process_time()
            extracted = extractor.extract(rgb)
            elapsed = np.array(time.process_time() - start)
            folder.mkdir(parents=True, exist_ok=True)
            descriptors = extracted.descriptors.astype(np.float16)
            save_npz(path, {"pixels": extracted.pixels, "descriptors": descriptors, "seconds": elapsed})
        cached = load_npz(path)
        keypoints.append(Keypoints(cached["pixels"], cached["descriptors"].astype(np.float32)))
        seconds.append(float(cached["seconds"]))
    return keypoints, seconds


def localize(localizer, keypoints, poses):
    """Return which views localize within 5 cm and 0.4 degrees, (B,), and the milliseconds of matching per view."""
    good = []
    spent = 0.0
    for of_view, pose in zip(keypoints, poses, strict=True):
        start = time.process_time()
        (matches,) = localizer.match([of_view])
        spent += time.process_time() - start
        result = localizer.estimate(of_view, matches)
        estimate = np.full((3, 4), np.nan) if result.cam_from_world is None else result.cam_from_world
        error_m, error_deg = pose_error(estimate, pose)
        good.append(result.status == LOCALIZED and error_m < 0.05 and error_deg < 0.4)
    return np.array(good), 1000 * spent / len(keypoints)


def numbers(scores, good):
    """Format AUC and regret of scores (L, D) of views that localize or not, with intervals over the L locations."""
    rng = np.random.default_rng(0)
    n = len(good)

    def measure(rows):
        g = good[rows]
        possible = g.any(1)
        chosen = np.take_along_axis(g, scores[rows].argmax(1)[:, None], axis=1)[:, 0]
        auc = roc_auc_score(g.ravel(), scores[rows].ravel()) if 0 < g.mean() < 1 else np.nan
        return auc, 100 * float(1 - chosen[possible].mean()) if possible.any() else np.nan

    auc, regret = measure(np.arange(n))
    draws = np.array([measure(rng.integers(0, n, n)) for _ in range(500)])
    low, high = np.nanpercentile(draws, (2.5, 97.5), axis=0)
    return f"{auc:.3f} ({low[0]:.3f} to {high[0]:.3f}) | {regret:.1f} ({low[1]:.1f} to {high[1]:.1f})"


def main():
    """Map, localize and score every scene by every extractor, and print the table."""
    args = options(
        __doc__, features=["opencv"], scenes=[901], locations=60, directions=12, map_images=100, device="cpu", work=...
    )
    use_one_thread()

    parts = {}
    for seed in args.scenes:
        folder = args.work / f"scene-{seed}"
        mesh = folder / "mesh.glb"
        folder.mkdir(parents=True, exist_ok=True)
        scene = open_scene(mesh if mesh.is_file() else None, folder, seed, args.device)
        views = random_views(scene, args.locations, args.directions, seed)
        occlusion = MeshOcclusion(scene.free_space.raycaster, two_sided=scene.free_space.two_sided)
        for each in args.features:
            name, _, weights = each.partition("=")
            config = ExtractorConfig(name, max_keypoints=2048, weights=weights)
            map_folder = folder / name / "map"
            if not (map_folder / "landmarks.npz").is_file():
                settings = MapConfig(n_images=args.map_images, extractor=config)
                build_map(scene.mesh, WarpRenderer(scene.mesh, args.device), scene.free_space, CAMERA, settings, seed,
                          map_folder, scene.free_space.raycaster, workers=1, device=args.device)  # fmt: skip
            extractor = KeypointExtractor(config, args.device)
            keypoints, seconds = keypoints_of(views, scene, extractor, folder / name / "keypoints", args.device)
            landmarks = Landmarks.load(map_folder / "landmarks.npz")
            full = LocalizationMap(Map(landmarks), CAMERA, occlusion, args.device)
            unknown = replace(landmarks, ambiguity=np.full_like(landmarks.ambiguity, np.nan))
            without = replace(full, map=Map(unknown))
            scorers = {"bundled": load_scorer(full), "without ambiguity": load_scorer(without)}
            scorers["bins"] = make_scorer("bins", full)
            localizer = Localizer(landmarks, CAMERA, device=args.device)
            good, match_ms = localize(localizer, keypoints, views)
            sizes = [len(landmarks), np.median([len(one) for one in keypoints]), np.median(seconds), match_ms]
            scores = [scorer.score(views) for scorer in scorers.values()]
            parts.setdefault(name, []).append((good, np.array(scores), sizes))

    print("| features | landmarks | keypoints | s an image | ms to match | localize | scorer | AUC | regret |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, of_scenes in parts.items():
        good = np.concatenate([part[0] for part in of_scenes])
        all_scores = np.concatenate([part[1] for part in of_scenes], axis=1)
        sizes = " | ".join(f"{value:.3g}" for value in np.mean([part[2] for part in of_scenes], axis=0))
        for scorer, scores in zip(("bundled", "without ambiguity", "bins"), all_scores, strict=True):
            values = numbers(scores.reshape(-1, args.directions), good.reshape(-1, args.directions))
            print(f"| {name} | {sizes} | {100 * good.mean():.1f} % | {scorer} | {values} |")


if __name__ == "__main__":
    main()
