"""The whole line from one command: all stages, an estimate of what remains, and in the end what came out."""

from __future__ import annotations

import textwrap
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from tqdm.auto import tqdm

from wheretolook import stages
from wheretolook.config import Experiment
from wheretolook.dataset.layout import STAGES, Dataset
from wheretolook.evaluation.report import best_in_words
from wheretolook.evaluation.results import SCORES_CSV, SCORES_MD, SCORES_PNG, results_folder
from wheretolook.evaluation.scores import read_scores
from wheretolook.geometry.poses import Float, camera_centers, poses_looking_along
from wheretolook.scorers.registry import methods_named, scorers
from wheretolook.stages.evaluate import not_logged
from wheretolook.stages.preconditions import Say, Tick, dataset_after, open_scene
from wheretolook.tracking.runs import ui_command
from wheretolook.tracking.store import check_store
from wheretolook.utils.artifact_cache import cache_key
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import fingerprint, write_json
from wheretolook.utils.reading import read_json
from wheretolook.utils.version import VERSION
from wheretolook.weights.resolve import load_scorer, resolve_weights

SECONDS = {"scenes": 5.0, "map": 15.0, "sample": 1.0, "label": 75.0, "train": 25.0, "evaluate": 6.0}
"""Rough cost of a stage on two cores (the first four for each scene), from which the share done is estimated."""

OVERVIEW = "overview.png"
LEVEL_DEG = 25.0  # pitch at most of a camera held level
STAMP = "compared.json"  # in the dataset's folder: what the demo's comparison was made from


def run_demo(experiment: Experiment) -> None:
    """Run every stage on an experiment, by default three procedural apartments to learn from and one to test on.

    Results that are there already, from the same settings, are reused.
    """
    config = experiment.scenes
    n_scenes = config.train + config.val + config.test + len(config.meshes)
    cost = {name: seconds * (n_scenes if name in STAGES else 1) for name, seconds in SECONDS.items()}
    functions = (stages.make_scenes, stages.make_maps, stages.sample, stages.label, stages.train, compare)
    steps: dict[str, Callable[..., object]] = dict(zip(SECONDS, functions, strict=True))
    if config.train == 0 and not any(mesh.split == "train" for mesh in config.meshes):
        del steps["train"], cost["train"]  # all scenes are evaluated, with weights from elsewhere
        asked = methods_named(experiment.evaluate.methods, scorers())
        if any(method.weights for method in asked) and not experiment.evaluate.weights:
            fix = "Name weights in evaluate.weights, or leave methods that have learnt out of evaluate.methods."
            raise ConfigError("no scene to learn from, and no weights to evaluate", fix=fix)
    print(f"Data go to {experiment.root.resolve()}, runs to {experiment.tracking.root}.")
    check_store(experiment.tracking)
    start = time.monotonic()
    layout = "{desc}: {percentage:3.0f}%|{bar}| {elapsed} elapsed, about {remaining} remain"
    with tqdm(total=sum(cost.values()), desc="demo", bar_format=layout, smoothing=0) as bar:
        for number, (name, step) in enumerate(steps.items(), 1):
            bar.set_description_str(f"demo {number}/{len(steps)} {name}")
            step(experiment, say=partial(_say, name), tick=partial(_tick, bar, SECONDS[name]))
        given = experiment.evaluate.weights
        own = experiment.root / "weights"
        known = (experiment.root / "results" / OVERVIEW).is_file()  # `compare` removes one that is out of date
        if not known and (given or any(own.glob("*.safetensors"))):
            draw_overview(experiment, given[-1] if given else own)
        bar.set_description_str("demo")
    _say_end(experiment, time.monotonic() - start)


def compare(experiment: Experiment, say: Say, tick: Tick) -> None:
    """The evaluate stage, with the weights that ship beside the dataset's own. What is there already is kept.

    Raises as `wheretolook.stages.evaluate.evaluate_methods`.
    """
    dataset = dataset_after(experiment, "label")
    config = experiment.evaluate
    tracking = experiment.tracking
    results = results_folder(dataset, config)
    stamp = experiment.root / STAMP
    bundled = resolve_weights(features=dataset.features)
    assert bundled is not None
    files = config.weights or [*sorted((experiment.root / "weights").glob("*.safetensors")), bundled]
    made_from: list[Any] = [dataset.fingerprint(), [fingerprint(path) for path in files if path.is_file()]]
    made_from += [asdict(config), asdict(experiment.occlusion), VERSION]
    scores = results / SCORES_CSV
    report = results / SCORES_MD

    def made() -> dict[str, str]:
        content = [fingerprint(path) for path in (scores, report)]
        return {"key": cache_key("evaluate", [*made_from, *content]), "runs": str(tracking.root)}

    try:
        known = read_json(stamp) == made() and (tracking.root / "mlflow.db").is_file()
        known = known and not not_logged(dataset).exists()
    except (OSError, ValueError):
        known = False
    if not known:
        from wheretolook.evaluation.scoring import own_weights
        from wheretolook.stages.evaluate import evaluate_methods

        models = list(config.weights) or [*own_weights(dataset), bundled]
        (results / OVERVIEW).unlink(missing_ok=True)
        device = experiment.warp_device
        occlusion = experiment.occlusion
        evaluate_methods(dataset, config, tracking, models, device=device, occlusion=occlusion, show=False)
        write_json(stamp, made())
    say(f"{'reusing' if known else 'all methods compared ->'} {report}")
    tick(1)


def draw_overview(experiment: Experiment, weights: Path) -> None:
    """Draw `<dataset>/results/overview.png`: the last scene's map, and what a network thinks of one place in it.

    The place is one where to look matters (`wheretolook.dataset.viewpoint_table.instructive_location`). The weights are a
    file, or a folder of files of which the best is taken, for a camera of the dataset's field of view. Raises
    TableError if there is no dataset or its last scene is not labelled, WeightsError if the weights cannot be used.
    """
    from wheretolook.dataset.viewpoint_table import instructive_location, outcome_in_words, poses, shares_good
    from wheretolook.figures.dollhouse import dollhouse
    from wheretolook.figures.overview import Overview, overview_figure, rendered_views
    from wheretolook.figures.style import save_figure, scene_label
    from wheretolook.scorers.styles import method_style

    dataset = Dataset.load(experiment.root)
    scene = open_scene(experiment, dataset, dataset.scenes[-1])
    table = scene.files.read_table()
    localization_map = scene.files.localization_map(scene.camera, scene.device)
    scorer = load_scorer(weights, localization_map)

    ids, first = np.unique(table["location_id"], return_index=True)
    locations = camera_centers(poses(table))[first]
    chosen = instructive_location(table)
    place = locations[np.searchsorted(ids, chosen)]
    candidates = table[table["location_id"] == chosen]
    scores = scorer.score(poses(candidates))
    best, worst = rendered_views(scene, *_ends(candidates, scores), outcome_in_words)
    directions = experiment.sample.axes()
    around = scorer.score(poses_looking_along(np.tile(place, (len(directions), 1)), directions))
    by_height = np.argsort(np.abs(locations[:, 2] - place[2]), kind="stable")
    shown = by_height[np.unique(locations[by_height, :2].round(2), axis=0, return_index=True)[1]]
    drawn = Overview(
        scene=scene_label(dataset.scenes[-1].name),
        method=method_style(scorer.name).label,
        plan=dollhouse(scene.mesh, elevation_deg=90, cut_m=float(place[2]), one_sided=False, device=scene.device),
        locations=locations[shown],
        share_good=shares_good(table)[1][shown],
        place=place,
        directions=directions,
        scores=around,
        best=best,
        worst=worst,
    )
    save_figure(overview_figure(drawn), dataset.root / "results" / OVERVIEW)


def _ends(candidates: pd.DataFrame, scores: Float) -> tuple[pd.DataFrame, Float]:
    """Rows and scores of the viewpoint with the highest score, and of the one with the lowest.

    The lowest is that of a camera held about level, if there is one: what a robot sees that looks ahead, and not the
    bare ceiling.
    """
    from wheretolook.dataset.viewpoint_table import poses

    pitch = np.arcsin(np.clip(poses(candidates)[:, 2, 2], -1, 1))
    level = np.abs(pitch) <= np.radians(LEVEL_DEG)
    lowest = np.where(level, scores, np.inf) if level.any() else scores
    ends = [int(np.argmax(scores)), int(np.argmin(lowest))]
    return candidates.iloc[ends], scores[ends]


def _say(stage: str, text: str) -> None:
    tqdm.write(f"[{stage}] {text}")


def _tick(bar: tqdm, seconds: float, work: float) -> None:
    bar.update(seconds * work)


def _say_end(experiment: Experiment, seconds: float) -> None:
    """What came out: who chose best, one picture, where the tables are, and what to do with a map of one's own."""
    results = results_folder(Dataset.load(experiment.root), experiment.evaluate)
    print(f"\nDone in {f'{seconds / 60:.1f} minutes' if seconds >= 60 else f'{seconds:.0f} s'}.\n")
    print(textwrap.fill(best_in_words(read_scores(results / SCORES_CSV)), 100))
    picture = experiment.root / "results" / OVERVIEW
    print(f"""
  picture       {picture if picture.is_file() else results / SCORES_PNG}
  tables        {results / SCORES_MD}
  runs          {ui_command(experiment.tracking)}
  your own map  wheretolook select --map SPARSE --at FILE --out FILE""")
