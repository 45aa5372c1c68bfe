"""The adapt stage: weights adapted to one scene, by views that were localized there."""

from __future__ import annotations

import shutil
import time
import warnings
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from wheretolook.config import Experiment
from wheretolook.dataset.folders import Dataset, SceneFolder, views_by_camera
from wheretolook.dataset.scene import Scene
from wheretolook.dataset.stamps import read_stamp
from wheretolook.stages.inputs import Say, Tick, extractor_of, open_scene, refuse_release
from wheretolook.stages.one_at_a_time import reading
from wheretolook.utils.errors import ConfigError, OutOfRangeWarning, SceneError, TableError, WeightsError
from wheretolook.utils.files import fingerprint, write_text
from wheretolook.utils.reading import read_json_object
from wheretolook.utils.shipped import WEIGHTS, shipped
from wheretolook.utils.tracking_store import check_store, kept_if_not_logged

if TYPE_CHECKING:
    from wheretolook.evaluation.adaptation import Gain
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.labelling.labeller import LabelTask
    from wheretolook.methods.adapted.fit import Adapted, LocalizedViews
    from wheretolook.methods.set.score import SetScorer

FOLDER = "adapted"  # of a dataset: adapted weights, and what they have gained
LEAST_VIEWS, LEAST_LOCATIONS, LEAST_OF_A_KIND = 100, 10, 10
_AT_ONCE = 128  # views between two looks at the clock
_PLACE = 256  # landmarks by which the place is known again


def adapt(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Path | None:
    """Adapt a scorer to one scene by its labels, or by views labelled now, in the time given: `<dataset>/adapted/`.

    Of views that were not learnt from it is told what the adapted weights have gained, in `<scene>.md` and an MLflow
    run. They are kept if their chances are truer by more than the 95 % interval and they do not choose worse by more
    than it. Returns their file, or None if the weights that it started from are not bettered.

    Raises:
        ConfigError: no such scene. SceneError: it has neither labels nor a mesh to render.
        TableError: it has no viewpoints, or too few, or all localize, or none.
        WeightsError: the weights to start from are not of the method `set`.
    """
    from wheretolook.evaluation.adaptation import compare_log_odds, gain_markdown
    from wheretolook.methods.adapted.fit import adapt as learn

    config = experiment.adapt
    refuse_release(experiment.root)
    with reading(experiment.root, "adapt", FOLDER):
        dataset = Dataset.load(experiment.root)
        files = _scene(dataset, config.scene)
        weights = config.weights or shipped(WEIGHTS) / "set.safetensors"
        path = config.out or dataset.root / FOLDER / f"{files.name}.safetensors"
        _check_out(path, weights)
        check_store(experiment.tracking)
        scene = open_scene(experiment, dataset, files)
        table = _labelled(experiment, files, scene, say)
        views = labelled_views(files, scene, table, weights)
        _check_enough(views, files)
        say(f"{files.name}: learning from {len(views):,} views, {views.good.mean():.0%} of which localize")
        learnt = learn(views, config.seed)
        gain = compare_log_odds(views.log_odds, learnt.held_out, views.good, views.group, views.centers, config.seed)
        text = gain_markdown(gain)
        write_text(path.with_suffix(".md"), f"# {files.name}: adapted by {len(views):,} views\n\n{text}")
        if gain.is_better:
            _save(path, files, scene, weights, learnt, views, gain)
            say(f"{text}\n{files.name}: the adapted weights are better -> {path}")
        else:
            say(f"{text}\n{files.name}: adapting does not make the weights better here: use {weights}")
            if config.out is None and path.is_file():  # of an earlier run, by other labels
                path.unlink()
                say(f"{files.name}: removed {path}, which an earlier run had made")
        with kept_if_not_logged(f"what was gained, {path.with_suffix('.md')},"):
            _log(experiment, dataset, files, weights, path, learnt, views, gain)
        tick(1)
        return path if gain.is_better else None


def _scene(dataset: Dataset, name: str) -> SceneFolder:
    if name:
        return dataset.scene(name)
    if len(dataset.scenes) != 1:
        names = ", ".join(scene.name for scene in dataset.scenes[:10])
        raise ConfigError("weights are adapted to one scene", path=dataset.root, fix=f"Give --scene: {names}.")
    return dataset.scenes[0]


def _check_out(path: Path, weights: Path) -> None:
    if path.suffix != ".safetensors" or path.is_dir():
        raise ConfigError("weights are a file", path=path, fix="Give --out a name that ends in .safetensors.")
    if path.resolve() == weights.resolve():
        fix = "Give --out another name."
        raise ConfigError("the adapted weights would replace those that they start from", path=path, fix=fix)


def _labelled(experiment: Experiment, files: SceneFolder, scene: Scene, say: Say) -> pd.DataFrame:
    """The scene's labelled viewpoints: all if the label stage has been here, else those that the time allows."""
    if read_stamp(files, "label") is not None:
        shutil.rmtree(files.adapt_shards, ignore_errors=True)  # of views that have labels now
        return files.read_table()
    if not files.mesh.is_file():
        problem = "this scene has neither labels nor a mesh that views could be rendered from"
        raise SceneError(problem, path=files.folder, fix="Use the weights that ship, or give the map a mesh.")
    if read_stamp(files, "sample") is None:
        problem = "the sample stage has not been run for this scene since its input was made"
        raise TableError(problem, path=files.folder, fix="Run `wheretolook sample`.")
    return _label_for(experiment, files, scene, say)


def _label_for(experiment: Experiment, files: SceneFolder, scene: Scene, say: Say) -> pd.DataFrame:
    """Label views for so many minutes, one location after the other in random order. What was labelled is kept."""
    from wheretolook.labelling.labeller import LabelTask, label_scenes
    from wheretolook.labelling.shard import SceneJob

    config, label = experiment.adapt, experiment.label
    table = files.read_table()
    if table.empty:
        return table
    ids, row = np.unique(table["location_id"].to_numpy(), return_inverse=True)
    order = np.random.default_rng(config.seed).permutation(len(ids))[row.reshape(-1)]
    table = table.iloc[np.argsort(order, kind="stable")].reset_index(drop=True)
    cameras = tuple(files.cameras().items()) if files.cameras_file.is_file() else ()
    options = (label.localizer, extractor_of(files), scene.device, False)
    job = SceneJob(files.mesh, files.landmarks, scene.camera, *options, cameras)
    begins = range(0, len(table), _AT_ONCE)
    parts = {begin: table.iloc[begin : begin + _AT_ONCE] for begin in begins}
    tasks = [
        LabelTask(f"{files.name} {begin}", job, part, files.adapt_shards / f"{begin:06}")
        for begin, part in parts.items()
    ]
    say(f"{files.name}: labelling up to {len(table):,} views, for {config.minutes:g} minutes at most")
    done: dict[str, pd.DataFrame] = {}
    end = None  # counted from the first views that are labelled now: what lay there comes at once
    with closing(label_scenes(tasks, label)) as results:
        for labelled in results:
            done[labelled.task.name] = labelled.table
            if labelled.seconds and end is None:
                end = time.monotonic() + 60 * config.minutes
            if end is not None and time.monotonic() >= end:
                break
    _remove_stale(files.adapt_shards, tasks)
    found = pd.concat([done[task.name] for task in tasks if task.name in done], ignore_index=True)
    if len(found) < len(table):
        say(f"{files.name}: {len(found):,} of {len(table):,} views labelled; run it again to go on with more")
    return found


def _remove_stale(folder: Path, tasks: list[LabelTask]) -> None:
    """Remove shards of other viewpoints, maps or settings; the others wait for a run that goes on."""
    from wheretolook.labelling.labeller import MANIFEST

    for path in folder.iterdir():
        if path not in {task.shards for task in tasks}:
            shutil.rmtree(path, ignore_errors=True)
    for task in tasks:
        current = read_json_object(task.shards / MANIFEST)["shards"]
        for path in task.shards.glob("*.parquet"):
            if path.name not in current:
                path.unlink()


def labelled_views(files: SceneFolder, scene: Scene, table: pd.DataFrame, weights: Path) -> LocalizedViews:
    """The labelled views, and what the weights to start from think of them."""
    from wheretolook.geometry.poses import camera_centers
    from wheretolook.methods.adapted.fit import LocalizedViews
    from wheretolook.methods.adapted.score import log_odds_of
    from wheretolook.viewpoints.table import is_good, poses

    cam_from_world, log_odds = poses(table), np.empty(len(table))
    for camera, rows in views_by_camera(files, table):
        scorer = _scorer(weights, files.localization_map(camera, scene.device))
        with warnings.catch_warnings():  # how far the weights hold here is what is measured
            warnings.simplefilter("ignore", OutOfRangeWarning)
            log_odds[rows] = log_odds_of(scorer.score(cam_from_world[rows]))
    axes, group = cam_from_world[:, 2, :3], table["location_id"].to_numpy(np.int64)
    return LocalizedViews(log_odds, is_good(table), camera_centers(cam_from_world), axes, group)


def _scorer(weights: Path, localization_map: LocalizationMap) -> SetScorer:
    from wheretolook.methods.registry import load_scorer
    from wheretolook.methods.set.score import SetScorer

    scorer = load_scorer(weights, localization_map)
    if not isinstance(scorer, SetScorer):
        fix = "Give weights of the method set, or leave them out for those that ship."
        raise WeightsError("only a set network is adapted", path=weights, value=scorer.name, fix=fix)
    return scorer


def _check_enough(views: LocalizedViews, files: SceneFolder) -> None:
    n_good, n_locations = int(views.good.sum()), len(np.unique(views.group))
    of_a_kind = min(n_good, len(views) - n_good)
    if len(views) < LEAST_VIEWS or n_locations < LEAST_LOCATIONS or of_a_kind < LEAST_OF_A_KIND:
        value = f"{len(views)} views at {n_locations} locations, {n_good} of which localize"
        problem = (
            f"adapting needs {LEAST_VIEWS} labelled views at {LEAST_LOCATIONS} locations, of which {LEAST_OF_A_KIND} "
            f"localize and {LEAST_OF_A_KIND} do not"
        )
        raise TableError(problem, path=files.table, value=value, fix="Sample more viewpoints, or give more minutes.")


def _save(
    path: Path, files: SceneFolder, scene: Scene, weights: Path, learnt: Adapted, views: LocalizedViews, gain: Gain
) -> None:
    import torch

    from wheretolook.learning.trained_network import TrainedNetwork
    from wheretolook.methods.adapted.network import AdaptedNetwork
    from wheretolook.methods.set.network import SetNetwork

    base, found = TrainedNetwork.load(weights, SetNetwork, "set"), learnt.adaptation
    points = files.read_landmarks().points
    place = points[np.arange(min(_PLACE, len(points))) * len(points) // max(1, min(_PLACE, len(points)))]
    sizes = len(found.weights), len(place)
    kernel = base.scale, base.offset, found.length_m, found.sharpness
    network = AdaptedNetwork(base.network, *kernel, *sizes)
    for name, values in (("centers", found.centers), ("axes", found.axes), ("weights", found.weights)):
        setattr(network, f"support_{name}", torch.from_numpy(np.array(values, dtype=np.float64)))
    network.place = torch.from_numpy(np.array(place, dtype=np.float64))
    trained = TrainedNetwork("adapted", network, base.camera, found.scale, found.offset, base.training_range)
    about = {"scene": files.name, "views": len(views), "weights_sha256": fingerprint(weights)}
    trained.save(path, {**about, "before": gain.before, "after": gain.after})


def _log(
    experiment: Experiment, dataset: Dataset, files: SceneFolder, weights: Path, path: Path, learnt: Adapted,
    views: LocalizedViews, gain: Gain,
) -> None:  # fmt: skip
    from wheretolook.utils.tracking import log, start_run

    params = {"dataset": dataset.name, "scene": files.name, "weights": weights, "views": len(views)}
    params |= {"length_m": learnt.length_m, "amplitude": learnt.amplitude, "scale": learnt.adaptation.scale}
    metrics = {**gain.after, **{f"{name}_before": value for name, value in gain.before.items()}}
    metrics |= {"better": float(gain.is_better), "log_loss_less": gain.log_loss_less[0]}
    with start_run(experiment.tracking, files.name, "adapt", params) as (client, run):
        log(client, run, metrics=metrics)
        client.log_artifact(run, str(path.with_suffix(".md")))
        if gain.is_better:
            client.log_artifact(run, str(path))
