"""Measure labelling: milliseconds per view of each step in one process.

    python tests/benchmarks/bench_labelling.py --scene SCENE --batches 8 16 32

SCENE is the folder of a mapped scene with `mesh.glb` and `map/`. One process renders, extracts, matches and estimates
poses batch by batch and synchronizes the device after each step. The first round is not counted.
"""

import time
from collections import Counter

import numpy as np
import torch
from common import free_points, open_scene, options, use_one_thread

from wheretolook.commands.options import extractor_of
from wheretolook.dataset.layout import SceneFolder
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.localizer import Localizer
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.rendering.warp_renderer import WarpRenderer


def main():
    args = options(__doc__, scene=..., views=256, batches=[8], methods=["first"], device="cpu")
    use_one_thread()
    folder = SceneFolder(args.scene, "test")
    rng = np.random.default_rng(0)
    scene = open_scene(args.scene, args.scene, 0, args.device)
    locations = free_points(scene.free_space, scene.mesh.bounds, args.views, rng)
    views = poses_looking_along(locations, rng.normal(size=locations.shape))
    camera = next(iter(folder.cameras().values()))
    renderer = WarpRenderer(scene.mesh, args.device)
    landmarks = Landmarks.load(folder.landmarks)
    for method in args.methods:
        localizer = Localizer(landmarks, camera, LocalizerConfig(method), extractor_of(folder), args.device)
        steps = {
            "render": lambda views: renderer.render(camera, views).rgb,
            "extract": localizer.extractor.extract_batch,
            "match": lambda keypoints, localizer=localizer: [*zip(keypoints, localizer.match(keypoints), strict=True)],
            "pose": lambda matched, localizer=localizer: localizer.estimate_batch(*zip(*matched, strict=True)),
        }
        for batch in args.batches:
            for _ in range(2):
                seconds = Counter()
                for start in range(0, len(views), batch):
                    result = views[start : start + batch]
                    for name, step in steps.items():
                        begin = time.perf_counter()
                        result = step(result)
                        if args.device != "cpu":
                            torch.cuda.synchronize()
                        seconds[name] += time.perf_counter() - begin
            parts = ", ".join(f"{name} {1000 * spent / len(views):.2f}" for name, spent in seconds.items())
            print(f"{method}, batches of {batch}, ms per view: {parts}", flush=True)


if __name__ == "__main__":
    main()
