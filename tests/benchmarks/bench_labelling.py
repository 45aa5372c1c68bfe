"""Measure labelling: milliseconds per view of each step in one process, and views per second of several workers.

    python tests/benchmarks/bench_labelling.py SCENE --views 400 --batches 8 16 32
    python tests/benchmarks/bench_labelling.py SCENE --device cuda --batches 8 --workers 1 2 4 8

SCENE is the folder of a mapped scene with `mesh.glb` and `map/`. One process renders, extracts (for ALIKED also its
parts), matches and estimates poses batch by batch and synchronizes the device after each step. With `--workers`, that
many processes label the same views like the label stage; the rate is taken between the first and the last tenth.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import open_scene, random_viewpoints, use_one_thread

from wheretolook.commands.preconditions import extractor_of
from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.viewpoint_table import poses
from wheretolook.features import aliked_batch
from wheretolook.localization import labeller
from wheretolook.localization.config import LabelConfig, LocalizerConfig
from wheretolook.localization.localizer import Localizer
from wheretolook.localization.shard import SceneJob
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


def time_steps(folder: SceneFolder, views: np.ndarray, batch: int, device: str) -> None:
    """Label views (B, 3, 4) in one process, step by step, and print milliseconds per view."""
    camera = next(iter(folder.cameras().values()))
    renderer = WarpRenderer(load_mesh(folder.mesh), device)
    localizer = Localizer(Landmarks.load(folder.landmarks), camera, LocalizerConfig(), extractor_of(folder), device)
    network = getattr(localizer.extractor._extraction, "_network", None)
    for warm_up in (True, False):
        watch = Stopwatch(device)
        if not warm_up and hasattr(network, "dkd"):
            watch.time_method(network, "extract_dense_map", "of it dense maps")
            watch.time_method(aliked_batch, "_detected", "detection")
            watch.time_method(aliked_batch, "_described", "description")
        for start in range(0, min(len(views), 2 * batch) if warm_up else len(views), batch):
            with watch("render"):
                rgb = renderer.render(camera, views[start : start + batch]).rgb
            with watch("extract"):
                keypoints = localizer.extractor.extract_batch(rgb)
            with watch("match"):
                matches = localizer.match(keypoints)
            with watch("pose"):
                for of_image, (rows, landmarks) in zip(keypoints, matches, strict=True):
                    localizer.estimate(of_image, rows, landmarks)
    steps = ", ".join(f"{step} {1000 * seconds / len(views):.2f}" for step, seconds in watch.seconds.items())
    peak = f"; peak {torch.cuda.max_memory_allocated() / 1e9:.2f} GB of PyTorch" if device != "cpu" else ""
    print(f"batches of {batch}, ms per view: {steps}{peak}", flush=True)


def time_workers(folder: SceneFolder, table: Any, workers: int, device: str) -> None:
    """Label a table with worker processes like the label stage, and print views per second."""
    ticks: list[tuple[float, int]] = []

    class RecordingBar(labeller.tqdm):  # type: ignore[misc, valid-type]
        def update(self, n: float | None = 1) -> bool | None:
            ticks.append((time.perf_counter(), int(n or 0)))
            return super().update(n)

    cameras = tuple(folder.cameras().items()) if folder.cameras_file.is_file() else ()
    extractor = extractor_of(folder)
    localizer = LabelConfig().localizer
    job = SceneJob(folder.mesh, folder.landmarks, folder.camera, localizer, extractor, device, False, cameras)
    config = LabelConfig(workers=workers, shard_size=max(8, min(64, len(table) // (4 * workers))))
    usual = labeller.tqdm
    labeller.tqdm = RecordingBar  # type: ignore[misc]
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as shards:
        (done,) = labeller.label_scenes([labeller.LabelTask("scene", job, table, Path(shards))], config, progress=False)
    labeller.tqdm = usual  # type: ignore[misc]
    n_done = np.cumsum([n for _, n in ticks])
    first, last = np.searchsorted(n_done, (0.1 * n_done[-1], 0.9 * n_done[-1]))
    rate = (n_done[last] - n_done[first]) / max(1e-9, ticks[last][0] - ticks[first][0])
    steps = ", ".join(f"{step} {1000 * seconds / len(table):.1f}" for step, seconds in done.seconds.items())
    print(f"{workers} workers: {rate:.0f} views per second; {len(table)} views with start-up in "
          f"{time.perf_counter() - start:.1f} s; workers' ms per view, overlapping: {steps}", flush=True)  # fmt: skip


def main() -> None:
    """Parse the options, measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("scene", type=Path, metavar="SCENE")
    add("--views", type=int, default=400, help="number of viewpoints (default: %(default)s)")
    add("--batches", nargs="*", type=int, default=[8], help="batch sizes (default: 8)")
    add("--workers", nargs="*", type=int, default=[], help="numbers of worker processes")
    add("--device", default="cpu")
    args = parser.parse_args()
    use_one_thread()
    folder = SceneFolder(args.scene, "test")
    if folder.table.is_file():
        table = folder.read_table()
    else:
        table = random_viewpoints(open_scene(folder.folder, folder.folder, 0, args.device), args.views, 0)
    table = table.iloc[np.linspace(0, len(table) - 1, min(args.views, len(table))).astype(int)].reset_index(drop=True)
    views = poses(table)[np.random.default_rng(0).permutation(len(table))][:256]
    for batch in args.batches:
        time_steps(folder, views, batch, args.device)
    for workers in args.workers:
        time_workers(folder, table, workers, args.device)


if __name__ == "__main__":
    main()
