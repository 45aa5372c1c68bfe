"""Where the time of labelling goes, stage by stage, and how many views a second workers label together.

    python tests/benchmarks/bench_labelling.py SCENE --views 400 --batches 8 16 32
    python tests/benchmarks/bench_labelling.py SCENE --device cuda --variants half channels_last --workers 1 2 4 8

SCENE is the folder of a mapped scene, with its `mesh.glb` and `map/`. First one process does the stages one after the
other, in batches, waiting for the device after each: rendering, extraction (of ALIKED also its parts), matching, pose.
`--variants` extracts the same images in other ways and tells how many keypoints stay: half is autocast to half
precision, channels_last the order of memory that suits tensor cores, contiguous the other one, plain kornia's ALIKED.
`--together` matches the images of a batch so many at a time. `--products` matches with other sizes of a block
of products, in bytes, and tells what each holds on the GPU. Then, with `--workers`, so many processes label the same
views as the label stage does; told is the rate between the first tenth and the last, without their start.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bench_scenes
import numpy as np
import torch

from wheretolook.dataset.layout import SceneFolder
from wheretolook.dataset.viewpoint_table import poses
from wheretolook.features import aliked_batch, matching, similarity
from wheretolook.features.extraction import KeypointExtractor
from wheretolook.localization import labeller
from wheretolook.localization.config import LabelConfig
from wheretolook.localization.localizer import Localizer
from wheretolook.localization.shard import SceneJob
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.stages.preconditions import extractor_of


class Stages:
    """Seconds of named stages, the device waited for at the end of each."""

    def __init__(self, device: str) -> None:
        self.on_gpu = device != "cpu"
        self.seconds = dict[str, float]()

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        start = self.now()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + self.now() - start

    def now(self) -> float:
        """The clock, once the device is done."""
        if self.on_gpu:
            torch.cuda.synchronize()
        return time.perf_counter()

    def timed(self, owner: Any, method: str, name: str) -> None:
        """Time every call of an object's method."""
        inner: Callable[..., Any] = getattr(owner, method)

        def call(*arguments: Any, **options: Any) -> Any:
            with self(name):
                return inner(*arguments, **options)

        setattr(owner, method, call)

    def told(self, n: int) -> str:
        """Milliseconds a view."""
        return ", ".join(f"{name} {1000 * spent / n:.2f}" for name, spent in self.seconds.items())


def by_stage(folder: SceneFolder, renderer: Any, views: Any, batch: int, device: str) -> list[Any]:
    """One process labels views in batches of so many, stage by stage; returns the images."""
    camera = next(iter(folder.cameras().values()))
    images = []
    localizer = Localizer(Landmarks.load(folder.landmarks), camera, None, extractor_of(folder), device)
    network = getattr(localizer.extractor._extraction, "_network", None)
    for warm in (True, False):
        clock = Stages(device)
        if not warm and hasattr(network, "dkd"):
            clock.timed(network, "extract_dense_map", "of it dense maps")
            clock.timed(aliked_batch, "_detected", "detection")
            clock.timed(aliked_batch, "_described", "description")
        for start in range(0, min(len(views), 2 * batch) if warm else len(views), batch):
            at = views[start : start + batch]
            with clock("render"):
                rgb = renderer.render(camera, at).rgb
            with clock("extract"):
                keypoints = localizer.extract(rgb)
            with clock("match"):
                matches = localizer.match(keypoints)
            with clock("pose"):
                for found, (rows, landmarks) in zip(keypoints, matches, strict=True):
                    localizer.estimate(found, rows, landmarks)
            images += [] if warm else [*rgb]
    peak = f"; at most {torch.cuda.max_memory_allocated() / 1e9:.2f} GB of PyTorch's" if device != "cpu" else ""
    print(f"batches of {batch}, ms a view: {clock.told(len(views))}{peak}", flush=True)
    return images


def variant(folder: SceneFolder, images: list[Any], name: str, batch: int, device: str) -> None:
    """Extracts images in another way, and tells how long it takes and how many keypoints stay."""
    config = extractor_of(folder)
    usual = KeypointExtractor(config, device)
    other = KeypointExtractor(config, device)
    extraction: Any = other._extraction
    kind = torch.device(device).type
    if name == "plain":
        extraction.detect = lambda x: [
            (at + 0.5, *rest) for at, *rest in aliked_batch.found_plain(extraction._network, x)
        ]
    elif name == "contiguous":
        inner = extraction.detect
        extraction.detect = lambda x: inner(x.contiguous())
    elif name == "channels_last":
        extraction._network.to(memory_format=torch.channels_last)
        inner = extraction.detect
        extraction.detect = lambda x: inner(x.contiguous(memory_format=torch.channels_last))
    elif name == "half":
        number = torch.float16 if kind == "cuda" else torch.bfloat16
        inner = extraction.detect

        def half(x: Any) -> Any:
            with torch.autocast(kind, number):
                return inner(x)

        extraction.detect = half
    parts = [images[i : i + batch] for i in range(0, len(images), batch)]
    other.extract_batch(parts[0])
    clock = Stages(device)
    with clock("extract"):
        found = [one for part in parts for one in other.extract_batch(part)]
    was = [one for part in parts for one in usual.extract_batch(part)]
    stay = 0
    near = 0
    total = 0
    cosine = []
    for a, b in zip(was, found, strict=True):
        total += len(a)
        if len(a) and len(b):
            apart = np.linalg.norm(a.pixels[:, None] - b.pixels[None], axis=-1)
            nearest = apart.argmin(1)
            close = apart.min(1)
            stay = stay + int((close < 0.01).sum())
            near = near + int((close < 0.5).sum())
            rows = close < 0.5
            cosine.append((a.descriptors[rows] * b.descriptors[nearest[rows]]).sum(1))
    within = [f"{100 * n / max(1, total):.1f} % within {px} px" for n, px in ((stay, 0.01), (near, 0.5))]
    likeness = np.quantile(np.concatenate(cosine), (0.05, 0.5)).round(5) if cosine else []
    told = f"{sum(map(len, found))} keypoints instead of {total}, of which lie {', '.join(within)}"
    ms = f"extract {1000 * clock.seconds['extract'] / len(images):.2f} ms a view"
    print(f"{name}: {ms}, {told}; cosine of descriptors {likeness} (5 %, median)", flush=True)


def blocks(folder: SceneFolder, images: list[Any], sizes: list[int], at_a_time: list[int], device: str) -> None:
    """Matches with blocks of products of other sizes, and so many images at a time."""
    landmarks = Landmarks.load(folder.landmarks)
    localizer = Localizer(landmarks, next(iter(folder.cameras().values())), None, extractor_of(folder), device)
    keypoints = localizer.extract(images[:16])
    kind = torch.device(device).type
    for size, together in [(size, 0) for size in sizes] + [(0, n) for n in at_a_time]:
        if together:
            similarity._TOGETHER[kind] = together
        else:
            matching._PRODUCT_BYTES[kind] = size
            similarity._PRODUCTS[kind] = size // 4
        spent = []
        for n in range(12):
            if device != "cpu" and n == 2:
                torch.cuda.empty_cache()
                torch.cuda.reset_peak_memory_stats()
            clock = Stages(device)
            with clock("match"):
                localizer.match(keypoints)
            spent.append(1000 * clock.seconds["match"] / len(keypoints))
        held = f", {torch.cuda.max_memory_reserved() / 1e9:.2f} GB held" if device != "cpu" else ""
        text = bench_scenes.format_spread(bench_scenes.spread(spent[2:]), 2)
        what = f"{together} images at a time" if together else f"blocks of {size / 2**20:.0f} MiB"
        print(f"{what}, {len(landmarks):,} landmarks: match {text} ms a view{held}", flush=True)


def together(folder: SceneFolder, table: Any, workers: int, device: str) -> None:
    """So many processes label a table."""
    ticks: list[tuple[float, int]] = []

    class Noted(labeller.tqdm):  # type: ignore[misc, valid-type]
        def update(self, n: float | None = 1) -> bool | None:
            ticks.append((time.perf_counter(), int(n or 0)))
            return super().update(n)

    usual, labeller.tqdm = labeller.tqdm, Noted  # type: ignore[misc]
    cameras = tuple(folder.cameras().items()) if folder.cameras_file.is_file() else ()
    start = time.perf_counter()  # fmt: skip
    job = SceneJob(
        folder.mesh,
        folder.landmarks,
        folder.camera,
        LabelConfig().localizer,
        extractor_of(folder),
        device,
        False,
        cameras,
    )
    with tempfile.TemporaryDirectory() as shards:
        config = LabelConfig(workers=workers, shard_size=max(8, min(64, len(table) // (4 * workers))))
        (done,) = labeller.label_scenes([labeller.LabelTask("scene", job, table, Path(shards))], config, progress=False)
    labeller.tqdm = usual  # type: ignore[misc]
    count = np.cumsum([n for _, n in ticks])
    first, last = np.searchsorted(count, (0.1 * count[-1], 0.9 * count[-1]))
    rate = (count[last] - count[first]) / max(1e-9, ticks[last][0] - ticks[first][0])
    steps = ", ".join(f"{step} {1000 * spent / len(table):.1f}" for step, spent in done.seconds.items())
    whole = time.perf_counter() - start
    print(f"{workers} workers: {rate:.0f} views a second; with their start {len(table)} in {whole:.1f} s; "
          f"workers' ms a view, which overlap: {steps}", flush=True)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("scene", type=Path, metavar="SCENE")
    add("--views", type=int, default=400, help="number of viewpoints (default: %(default)s)")
    add("--batches", nargs="*", type=int, default=[8], help="views that go together (default: 8)")
    add(
        "--variants",
        nargs="*",
        choices=["plain", "contiguous", "half", "channels_last"],
        default=[],
        help="other ways to extract",
    )
    add("--products", nargs="*", type=int, default=[], help="bytes of a block of products")
    add("--together", nargs="*", type=int, default=[], help="images to match at a time")
    add("--workers", nargs="*", type=int, default=[], help="numbers of processes to label with")
    add("--device", default="cpu")
    args = parser.parse_args()
    bench_scenes.use_one_thread()
    folder = SceneFolder(args.scene, "test")
    if folder.table.is_file():
        table = folder.read_table()
    else:
        table = bench_scenes.viewpoints_anywhere(
            bench_scenes.open_scene(folder.folder, folder.folder, 0, args.device), args.views, 0
        )
    table = table.iloc[np.linspace(0, len(table) - 1, min(args.views, len(table))).astype(int)].reset_index(drop=True)
    images: list[Any] = []
    if args.batches or args.variants or args.products or args.together:
        from wheretolook.scenes.loading import load_mesh

        renderer = WarpRenderer(load_mesh(folder.mesh), args.device)
        at = poses(table)[np.random.default_rng(0).permutation(len(table))][: max(8, min(len(table), 256))]
        for batch in args.batches:
            images = by_stage(folder, renderer, at, batch, args.device)
        for name in args.variants:
            variant(folder, images, name, args.batches[-1], args.device)
        if args.products or args.together:
            blocks(folder, images, args.products, args.together, args.device)
    for workers in args.workers:
        together(folder, table, workers, args.device)


if __name__ == "__main__":
    main()
