"""The whole line from one command: all stages, an estimate of what remains, and where each result lies."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from tqdm.auto import tqdm

from wheretolook import stages
from wheretolook.config import Experiment
from wheretolook.dataset.folders import Dataset
from wheretolook.dataset.stamps import STAGES
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.poses import camera_centers, poses_looking_along
from wheretolook.methods.registry import load_scorer, methods_named, scorers
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.tracking import ui_command
from wheretolook.viewpoints.table import is_good, outcome_in_words, poses

SECONDS = {"scenes": 5.0, "map": 15.0, "sample": 1.0, "label": 75.0, "train": 25.0, "evaluate": 6.0}
"""Rough cost of a stage on two cores (the first four for each scene), from which the share done is estimated."""


OVERVIEW = "overview.png"


def run_demo(experiment: Experiment) -> None:
    """Run every stage on an experiment, by default three procedural apartments to learn from and one to test on.

    Results that are there already, from the same settings, are reused.
    """
    config = experiment.scenes
    n_scenes = config.train + config.val + config.test + len(config.meshes)
    cost = {name: seconds * (n_scenes if name in STAGES else 1) for name, seconds in SECONDS.items()}
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
        asked = methods_named(experiment.evaluate.methods, scorers())
        if any(method.weights for method in asked) and not experiment.evaluate.weights:
            raise ConfigError(
                "no scene to learn from, and no weights to evaluate",
                fix="Name weights in evaluate.weights, or leave methods that have learnt out of evaluate.methods.",
            )
    start = time.monotonic()
    layout = "{desc}: {percentage:3.0f}%|{bar}| {elapsed} elapsed, about {remaining} remain"
    with tqdm(total=sum(cost.values()), desc="demo", bar_format=layout, smoothing=0) as bar:
        for number, (name, step) in enumerate(steps.items(), 1):
            bar.set_description_str(f"demo {number}/{len(steps)} {name}")
            say, tick = partial(_say, name), partial(_tick, bar, SECONDS[name])
            step(experiment, say=say, tick=tick)
        given, own = experiment.evaluate.weights, experiment.root / "weights"
        if given or any(own.glob("*.safetensors")):
            draw_overview(experiment, given[-1] if given else own)
        bar.set_description_str("demo")
    _say_where(experiment, time.monotonic() - start)


def draw_overview(experiment: Experiment, weights: Path) -> Path:
    """Draw `<dataset>/results/overview.png`: the last scene's map, and what a network thinks of one place in it.

    The place is the labelled location where the share of viewpoints that localize is nearest to one half, so that
    there is something to choose.

    Args:
        experiment: all stages up to label have been run.
        weights: file of a trained scorer, or a folder of such files, of which the best is taken; its camera must have
            the dataset's field of view.

    Returns:
        The picture's path.

    Raises:
        TableError: there is no dataset, or its last scene is not labelled.
        WeightsError: the weights cannot be used.
    """
    from wheretolook.figures.overview import View, overview_figure
    from wheretolook.figures.style import save_figure

    dataset = Dataset.load(experiment.root)
    scene = dataset.scenes[-1]
    table = scene.read_table()
    localization_map = scene.localization_map(dataset.camera, experiment.warp_device)
    scorer = load_scorer(weights, localization_map)

    centers, good = camera_centers(poses(table)), is_good(table)
    ids, first, rows = np.unique(table["location_id"], return_index=True, return_inverse=True)
    share = np.bincount(rows, weights=good) / np.bincount(rows)
    chosen = int(np.argmin(np.abs(share - 0.5)))
    place = centers[first[chosen]]
    candidates = table[table["location_id"] == ids[chosen]]
    candidate_scores = scorer.score(poses(candidates))
    renderer = WarpRenderer(load_mesh(scene.mesh), experiment.warp_device)

    def view(row: int) -> View:
        pose = poses(candidates.iloc[[row]])
        label = candidates.iloc[row]
        rgb = renderer.render(dataset.camera, pose).rgb[0]
        return View(rgb, pose[0, 2, :3], float(candidate_scores[row]), outcome_in_words(label))

    directions = direction_lattice(experiment.sample.directions, experiment.sample.lattice)
    figure = overview_figure(
        localization_map.landmarks.points,
        centers[first],
        share,
        place,
        directions,
        scorer.score(poses_looking_along(np.tile(place, (len(directions), 1)), directions)),
        view(int(np.argmax(candidate_scores))),
        view(int(np.argmin(candidate_scores))),
    )
    path = dataset.root / "results" / OVERVIEW
    save_figure(figure, path)
    return path


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
        ("overview", dataset.root / "results" / OVERVIEW),
        ("trained weights", dataset.root / "weights"),
        ("a scene", scene.mesh),
        ("its COLMAP map", scene.map),
        ("its viewpoints", scene.table),
    ]
    print(f"\nDone in {seconds / 60:.1f} minutes.")
    for name, path in rows:
        print(f"  {name:<16}{path}")
    print(f"  compare runs    {ui_command(experiment.tracking)}")
