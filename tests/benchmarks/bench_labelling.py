"""Measure labelling: milliseconds per view of each step in one process.

    python tests/benchmarks/bench_labelling.py SCENE --batches 8 16 32

SCENE is the folder of a mapped scene with `mesh.glb` and `map/`. One process renders, extracts (for ALIKED also its
parts), matches and estimates poses batch by batch and synchronizes the device after each step.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import free_points, open_scene, use_one_thread

from wheretolook.commands.options import extractor_of
from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.viewpoint_table import poses
from wheretolook.features import learned
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.localizer import Localizer
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh


class Stopwatch:
    """Accumulates seconds by step, synchronizing the device at the end of each."""

    def __init__(self, device: str) -> None:
        self.on_gpu = device != "cpu"
        self.seconds = dict[str, float]()

    @contextmanager
    def __call__(self, step: str) -> Iterator[None]:
        start = self._now()
        yield
        self.seconds[step] = self.seconds.get(step, 0.0) + self._now() - start

    def time_method(self, owner: Any, method: str, step: str) -> None:
        """Time every call of an object's method as a step."""
        inner: Callable[..., Any] = getattr(owner, method)

        def call(*arguments: Any, **options: Any) -> Any:
            with self(step):
                return inner(*arguments, **options)

        setattr(owner, method, call)

    def _now(self) -> float:
        if self.on_gpu:
            torch.cuda.synchronize()
        return time.perf_counter()


def time_steps(folder: SceneFolder, views: np.ndarray, batch: int, device: str, config: LocalizerConfig) -> None:
    """Label views (B, 3, 4) in one process, step by step, and print milliseconds per view."""
    camera = next(iter(folder.cameras().values()))
    renderer = WarpRenderer(load_mesh(folder.mesh), device)
    localizer = Localizer(Landmarks.load(folder.landmarks), camera, config, extractor_of(folder), device)
    network = getattr(localizer.extractor._extraction, "_network", None)
    for warm_up in (True, False):
        watch = Stopwatch(device)
        if not warm_up and hasattr(network, "dkd"):
            watch.time_method(learned, "_maps", "of it network")
            watch.time_method(learned, "_detected", "detection")
            watch.time_method(learned, "_described", "description")
        for start in range(0, min(len(views), 2 * batch) if warm_up else len(views), batch):
            with watch("render"):
                rgb = renderer.render(camera, views[start : start + batch]).rgb
            with watch("extract"):
                keypoints = localizer.extractor.extract_batch(rgb)
            with watch("match"):
                matches = localizer.match(keypoints)
            with watch("pose"):
                for of_image, matched in zip(keypoints, matches, strict=True):
                    localizer.estimate(of_image, matched)
    steps = ", ".join(f"{step} {1000 * seconds / len(views):.2f}" for step, seconds in watch.seconds.items())
    peak = f"; peak {torch.cuda.max_memory_allocated() / 1e9:.2f} GB of PyTorch" if device != "cpu" else ""
    print(f"{config.method}, batches of {batch}, ms per view: {steps}{peak}", flush=True)


def main() -> None:
    """Parse the options, measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("scene", type=Path, metavar="SCENE")
    add("--views", type=int, default=256, help="number of viewpoints (default: %(default)s)")
    add("--batches", nargs="*", type=int, default=[8], help="batch sizes (default: 8)")
    add("--methods", nargs="*", default=["first"], help="of the localizer: first, hypotheses (default: first)")
    add("--device", default="cpu")
    args = parser.parse_args()
    use_one_thread()
    folder = SceneFolder(args.scene, "test")
    rng = np.random.default_rng(0)
    if folder.table.is_file():
        views = poses(folder.read_table())
    else:
        scene = open_scene(folder.folder, folder.folder, 0, args.device)
        locations = free_points(scene.free_space, scene.mesh.bounds, args.views, rng)
        views = poses_looking_along(locations, rng.normal(size=locations.shape))
    views = views[rng.permutation(len(views))][: args.views]
    for method in args.methods:
        for batch in args.batches:
            time_steps(folder, views, batch, args.device, LocalizerConfig(method))


if __name__ == "__main__":
    main()
