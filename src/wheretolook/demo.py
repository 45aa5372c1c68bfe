"""The whole line from one command: all stages, an estimate of what remains, and where each result lies."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

from tqdm.auto import tqdm

from wheretolook import stages
from wheretolook.config import Experiment
from wheretolook.dataset import Dataset
from wheretolook.tracking import ui_command

SECONDS = {"scenes": 10.0, "map": 25.0, "sample": 3.0, "label": 60.0, "train": 60.0, "evaluate": 15.0}
"""Rough cost of a stage on two cores (the first four for each scene), from which the share done is estimated."""


def run_demo(experiment: Experiment) -> None:
    """Run every stage on an experiment, by default three procedural apartments to learn from and one to test on.

    Results that are there already, from the same settings, are reused.
    """
    config = experiment.scenes
    n_scenes = config.train + config.val + config.test + len(config.meshes)
    cost = {name: seconds * (n_scenes if name in stages.STAGES else 1) for name, seconds in SECONDS.items()}
    steps: dict[str, Callable[..., object]] = {
        "scenes": stages.make_scenes,
        "map": stages.make_maps,
        "sample": stages.sample,
        "label": stages.label,
        "train": stages.train,
        "evaluate": stages.evaluate,
    }
    if config.train == 0 and not any(mesh.split == "train" for mesh in config.meshes):
        del steps["train"], cost["train"]  # meshes of one's own, evaluated with weights from elsewhere
    start = time.monotonic()
    layout = "{desc}: {percentage:3.0f}%|{bar}| {elapsed} elapsed, about {remaining} remain"
    with tqdm(total=sum(cost.values()), desc="demo", bar_format=layout, smoothing=0) as bar:
        for number, (name, step) in enumerate(steps.items(), 1):
            bar.set_description_str(f"demo {number}/{len(steps)} {name}")
            say, tick = partial(_say, name), partial(_tick, bar, SECONDS[name])
            step(experiment, say=say, tick=tick)
        bar.set_description_str("demo")
    _say_where(experiment, time.monotonic() - start)


def _say(stage: str, text: str) -> None:
    tqdm.write(f"[{stage}] {text}")


def _tick(bar: tqdm, seconds: float, work: float) -> None:
    bar.update(seconds * work)


def _say_where(experiment: Experiment, seconds: float) -> None:
    dataset = Dataset.load(experiment.root)
    scene = dataset.scenes[-1]
    rows = [
        ("score table", dataset.root / "results" / "scores.md"),
        ("score figure", dataset.root / "results" / "scores.png"),
        ("trained weights", dataset.root / "weights"),
        ("a scene", scene.mesh),
        ("its COLMAP map", scene.map),
        ("its viewpoints", scene.table),
    ]
    print(f"\nDone in {seconds / 60:.1f} minutes.")
    for name, path in rows:
        print(f"  {name:<16}{path}")
    print(f"  compare runs    {ui_command(experiment.tracking)}")
