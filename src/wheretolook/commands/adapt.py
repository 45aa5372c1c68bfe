"""`wheretolook adapt`: weights adapted to one scene, by views that were localized there."""

from __future__ import annotations

import shutil
import time
import warnings
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from wheretolook.commands.holdout_photos import check_name, hold_out_photographs, knows_photographs
from wheretolook.commands.options import LabelOptions, Log, Progress, SceneOptions, ignore_progress
from wheretolook.commands.preconditions import extractor_of, open_scene, refuse_release
from wheretolook.dataset.dataset_lock import reading
from wheretolook.dataset.environment import SceneEnvironment
from wheretolook.dataset.layout import Dataset, SceneFolder, views_by_camera
from wheretolook.geometry.poses import Float
from wheretolook.mapping.config import ExistingModelConfig
from wheretolook.scorers.adapted.config import AdaptConfig
from wheretolook.tracking.config import TrackingConfig
from wheretolook.tracking.store import check_store, kept_if_not_logged
from wheretolook.utils.errors import ConfigError, MapError, OutOfRangeWarning, SceneError, TableError, WeightsError
from wheretolook.utils.files import fingerprint, write_text
from wheretolook.utils.locks import hold
from wheretolook.utils.reading import read_json_object
from wheretolook.weights.resolve import resolve_weights

if TYPE_CHECKING:
    import pandas as pd

    from wheretolook.evaluation.adaptation import Gain
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.localization.labeller import LabelTask
    from wheretolook.scorers.adapted.gp_correction import Adapted, LocalizedViews
    from wheretolook.scorers.base import Scorer
    from wheretolook.visibility.occlusion import OcclusionModel

FOLDER = "adapted"  # of a dataset: adapted weights, and what they have gained
LEAST_VIEWS = 100
LEAST_LOCATIONS = 10
LEAST_OF_A_KIND = 10
_AT_ONCE = 128  # views between two looks at the clock
_MAX_SIGNATURE = 256  # landmarks by which the scene is recognized


@dataclass(frozen=True)
class _Target:
    """What weights are adapted to, and where they go."""

    name: str
    dataset: str  # its name; empty for a map of one's own
    source: Path  # what errors name
    weights: Path  # to start from
    path: Path  # of the adapted weights


@dataclass(frozen=True, kw_only=True)
class Adapt(SceneOptions, LabelOptions):
    """Adapt the bundled weights to one scene by views localized there; keep them only if they are better.

    Uses the photographs of a COLMAP model (--map) or of a scene made of photographs, held out in blocks as `wheretolook
    check` does; and a scene's labels, or, without labels but with a mesh, as many of its viewpoints as can be labelled
    in the given minutes; run again, it continues with more. The weights are for this scene alone:

      wheretolook select --map sparse/0 --weights data/checks/mymap/adapted.safetensors --at 1,2,1.4 --out views.csv

    Examples:
      wheretolook adapt --map sparse/0 --database database.db
      wheretolook adapt --config configs/demo.yaml --scene apartment-000 --minutes 5

    Args:
        adapt: which scene or map, its photographs, and the weights.
        tracking: where MLflow keeps its runs.
    """

    SHORT: ClassVar = {
        **{name: f"adapt.{name}" for name in ("scene", "map", "images", "database", "weights", "out", "minutes")},
        "engine": "label.engine",
    }

    adapt: AdaptConfig = field(default_factory=AdaptConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)

    def run(self, log: Log = print, progress: Progress = ignore_progress) -> Path | None:
        """Adapt a set scorer to one scene, or to a COLMAP map of photographs, by views that were localized there.

        Cross-validated measures before and after go to `<scene>.md` and an MLflow run. The weights are kept if the
        probabilities are better by more than the 95 % interval and the choice of views is not worse by more than it;
        with both kinds of views, those of the photographs must not be worse by more than it. Returns the file of the
        adapted weights, or None if they are not better.

        Raises:
            ConfigError: no such scene. SceneError: it has neither labels, nor a mesh to render, nor photographs.
            TableError: it has no viewpoints, or too few, or all localize, or none.
            WeightsError: the weights to start from are not of the method `set`.
            MapError: the map is not in metres, or on its side, or its photographs' features are not known.
        """
        config = self.adapt
        weights = resolve_weights("set", config.weights)
        assert weights is not None
        if config.map is not None:
            return _adapt_map(self, config.map, weights, log, progress)
        refuse_release(self.root)
        with reading(self.root, "adapt", FOLDER):
            dataset = Dataset.load(self.root)
            files = _scene(dataset, config.scene)
            if config.weights is None:
                weights = resolve_weights("set", features=dataset.features)
                assert weights is not None
            path = config.out or dataset.root / FOLDER / f"{files.name}.safetensors"
            _check_out(path, weights)
            check_store(self.tracking)
            scene = open_scene(self, files)
            has_photographs = knows_photographs(files, config.images, config.database)
            table = _labelled(self, files, scene, has_photographs, log)
            views = None if table is None else labelled_views(files, scene, table, weights)
            if has_photographs:
                if files.is_photographed:
                    scene.require_metres()
                name = check_name(self, files)
                try:
                    held_out = _held_out_views(self, files.map, scene.occlusion, weights, name, log)
                    views = held_out if views is None else views.joined(held_out)
                except MapError as error:
                    if views is None:
                        raise
                    log(f"{files.name}: its photographs are not used: {error}")
            assert views is not None
            _check_enough(views, files.table if table is not None else files.map)
            target = _Target(files.name, dataset.name, files.table, weights, path)
            return _fit(self, target, views, files.read_landmarks().points, log, progress)


def _adapt_map(options: Adapt, model: Path, weights: Path, log: Log, progress: Progress) -> Path | None:
    """Adapt to a COLMAP map by its photographs only."""
    from wheretolook.dataset.environment import ColmapEnvironment, ColmapFiles
    from wheretolook.holdout.photo_map import folder_of_check
    from wheretolook.mapping.colmap_model import model_arrays, read_model
    from wheretolook.mapping.georeference import read_scale

    name = ExistingModelConfig(model=model).scene_name
    path = options.adapt.out or folder_of_check(options.data, name) / "adapted.safetensors"
    _check_out(path, weights)
    check_store(options.tracking)
    scale = read_scale(model)
    if scale is not None and not scale.is_metric and not options.map.photographs.assume_metric:
        fix = "Map it with a scale (map.photographs.scale), or pass --map.photographs.assume_metric true."
        raise MapError("the map has no scale, and this needs metres", path=model, value=scale.source, fix=fix)
    points = model_arrays(read_model(model)).points
    occlusion = "none" if options.occlusion.model == "none" else "hidden-points"
    environment = ColmapEnvironment(ColmapFiles(model), occlusion=occlusion, device=options.warp_device)
    views = _held_out_views(options, model, environment.occlusion, weights, name, log)
    _check_enough(views, model)
    with hold(path.with_name(f".{path.name}.lock"), "adapt"):
        return _fit(options, _Target(name, "", model, weights, path), views, points, log, progress)


def _held_out_views(
    options: Adapt, model: Path, occlusion: OcclusionModel, weights: Path, name: str, log: Log
) -> LocalizedViews:
    """A map's photographs, left out in blocks: in the folder of its check, so that neither does it again."""
    from wheretolook.holdout.holdout_views import photographed_views

    _set_scorer_file(weights)  # refused now, not after the work
    settings = options.adapt
    mesh = occlusion.name == "mesh"
    given = (settings.images, settings.database)
    source, held_out = hold_out_photographs(options, "adapt", model, name, True, mesh, *given, log, True)
    return photographed_views(source, held_out, weights, occlusion, options.warp_device)


def _fit(
    options: Adapt, target: _Target, views: LocalizedViews, points: Float, log: Log, progress: Progress
) -> Path | None:
    """Adapt to localized views; keep the weights if they are better, report and log the gain."""
    from wheretolook.evaluation.adaptation import compare_log_odds, gain_markdown
    from wheretolook.scorers.adapted.gp_correction import adapt as fit

    name = target.name
    path = target.path
    seed = options.adapt.seed
    photographs = views.photograph >= 0
    kinds = {"rendered views": ~photographs, "left-out photographs": photographs}
    counts = " and ".join(f"{rows.sum():,} {kind}" for kind, rows in kinds.items() if rows.any())
    log(f"{name}: fitting to {counts}, {views.good.mean():.0%} of which localize")
    adapted = fit(views, seed)

    def gain_of(rows: NDArray[np.bool_]) -> Gain:
        some = views.rows(rows)
        judged = some.good, some.place, some.centers, seed, some.blocks
        return compare_log_odds(some.log_odds, adapted.held_out[rows], *judged)

    gain = gain_of(np.ones(len(views), dtype=bool))
    text = gain_markdown(gain)
    is_better = gain.is_better
    if photographs.any() and not photographs.all():
        of_photographs = gain_of(photographs)
        is_better = is_better and not of_photographs.is_worse
        text += f"\nPhotographs only:\n\n{gain_markdown(of_photographs)}"
    write_text(path.with_suffix(".md"), f"# {name}: adapted by {counts}\n\n{text}")
    if is_better:
        _save(target, points, adapted, views, gain)
        log(f"{text}\n{name}: the adapted weights are better -> {path}")
    else:
        log(f"{text}\n{name}: adapting does not make the weights better here: use {target.weights}")
        if options.adapt.out is None and path.is_file():  # of an earlier run, by other labels
            path.unlink()
            log(f"{name}: removed {path}, which an earlier run had made")
    with kept_if_not_logged(f"what was gained, {path.with_suffix('.md')},"):
        _log(options, target, adapted, views, gain, is_better)
    progress(1)
    return path if is_better else None


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
    if (within := next(folder for folder in path.absolute().parents if folder.exists())).is_file():
        raise ConfigError("this is a file, no folder", path=within, fix="Give --out another folder.")
    if path.resolve() == weights.resolve():
        fix = "Give --out another name."
        raise ConfigError("the adapted weights would replace those that they start from", path=path, fix=fix)


def _labelled(
    options: Adapt, files: SceneFolder, scene: SceneEnvironment, has_photographs: bool, log: Log
) -> pd.DataFrame | None:
    """The scene's labelled viewpoints: all if the label stage has been here, else those that the time allows.

    None where there are only photographs.
    """
    if files.stage_cache("label").stored_key is not None:
        shutil.rmtree(files.adapt_shards, ignore_errors=True)  # of views that have labels now
        return files.read_table()
    if not files.mesh.is_file():
        if has_photographs:
            return None
        problem = "this scene has neither labels, nor a mesh to render views of, nor the photographs of its map"
        fix = "Give --database or --images, the map's photographs, or use the weights that ship."
        raise SceneError(problem, path=files.folder, fix=fix)
    if files.stage_cache("sample").stored_key is None:
        if has_photographs:
            log(f"{files.name}: no viewpoints are sampled, so only photographs are used")
            return None
        problem = "the sample stage has not been run for this scene since its input was made"
        raise TableError(problem, path=files.folder, fix="Run `wheretolook sample`.")
    return _label_for(options, files, scene, log)


def _label_for(options: Adapt, files: SceneFolder, scene: SceneEnvironment, log: Log) -> pd.DataFrame:
    """Label views for so many minutes, one location after the other in random order. What was labelled is kept."""
    import pandas as pd

    from wheretolook.localization.labeller import LabelTask, label_scenes
    from wheretolook.localization.shard import SceneJob

    config = options.adapt
    label = options.label
    table = files.read_table()
    if table.empty:
        return table
    ids, row = np.unique(table["location_id"].to_numpy(), return_inverse=True)
    order = np.random.default_rng(config.seed).permutation(len(ids))[row.reshape(-1)]
    table = table.iloc[np.argsort(order, kind="stable")].reset_index(drop=True)
    cameras = tuple(files.cameras().items()) if files.cameras_file.is_file() else ()
    how = (label.localizer, extractor_of(files, options.map.extractor), scene.device, False)
    job = SceneJob(files.mesh, files.landmarks, scene.camera, *how, cameras)
    begins = range(0, len(table), _AT_ONCE)
    parts = {begin: table.iloc[begin : begin + _AT_ONCE] for begin in begins}
    tasks = [
        LabelTask(f"{files.name} {begin}", job, part, files.adapt_shards / f"{begin:06}")
        for begin, part in parts.items()
    ]
    log(f"{files.name}: labelling up to {len(table):,} views, for {config.minutes:g} minutes at most")
    done: dict[str, pd.DataFrame] = {}
    end = None  # counted from when work began on the first views that are labelled now: what lay there comes at once
    with closing(label_scenes(tasks, label)) as results:
        for labelled in results:
            done[labelled.task.name] = labelled.table
            if labelled.seconds and end is None:
                end = time.monotonic() + 60 * config.minutes - sum(labelled.seconds.values()) / options.n_workers
            if end is not None and time.monotonic() >= end:
                break
    _remove_stale(files.adapt_shards, tasks)
    labelled_table = pd.concat([done[task.name] for task in tasks if task.name in done], ignore_index=True)
    if len(labelled_table) < len(table):
        log(f"{files.name}: {len(labelled_table):,} of {len(table):,} views labelled; run it again to go on with more")
    return labelled_table


def _remove_stale(folder: Path, tasks: list[LabelTask]) -> None:
    """Remove shards of other viewpoints, maps or settings; the others wait for a run that goes on."""
    from wheretolook.localization.labeller import MANIFEST

    for path in folder.iterdir():
        if path not in {task.shards for task in tasks}:
            shutil.rmtree(path, ignore_errors=True)
    for task in tasks:
        current = read_json_object(task.shards / MANIFEST)["shards"]
        for path in task.shards.glob("*.parquet"):
            if path.name not in current:
                path.unlink()


def labelled_views(files: SceneFolder, scene: SceneEnvironment, table: pd.DataFrame, weights: Path) -> LocalizedViews:
    """The labelled views, and what the weights to start from think of them."""
    from wheretolook.dataset.viewpoint_table import is_good, poses
    from wheretolook.geometry.poses import camera_centers
    from wheretolook.scorers.adapted.gp_correction import LocalizedViews
    from wheretolook.scorers.adapted.score import log_odds_of

    cam_from_world = poses(table)
    log_odds = np.empty(len(table))
    for camera, rows in views_by_camera(files, table):
        scorer = _scorer(weights, files.localization_map(camera, scene.device))
        with warnings.catch_warnings():  # how far the weights hold here is what is measured
            warnings.simplefilter("ignore", OutOfRangeWarning)
            log_odds[rows] = log_odds_of(scorer.score(cam_from_world[rows]))
    axes = cam_from_world[:, 2, :3]
    group = table["location_id"].to_numpy(np.int64)
    return LocalizedViews(log_odds, is_good(table), camera_centers(cam_from_world), axes, group)


def _scorer(weights: Path, localization_map: LocalizationMap) -> Scorer:
    from wheretolook.weights.resolve import load_scorer

    _set_scorer_file(weights)
    return load_scorer(weights, localization_map)


def _set_scorer_file(weights: Path) -> None:
    """Raise WeightsError unless a file has weights of a set network."""
    from wheretolook.training.weights import method_of_weights

    if (kind := method_of_weights(weights)) != "set":
        fix = "Give weights of the method set, or leave them out for those that ship."
        raise WeightsError("only a set network is adapted", path=weights, value=kind, fix=fix)


def _check_enough(views: LocalizedViews, source: Path) -> None:
    n_good = int(views.good.sum())
    n_locations = len(np.unique(views.group))
    of_a_kind = min(n_good, len(views) - n_good)
    rendered = views.photograph < 0
    few = rendered.any() and (len(views) < LEAST_VIEWS or n_locations < LEAST_LOCATIONS)
    if few or of_a_kind < LEAST_OF_A_KIND:
        if not rendered.any():
            value = f"{len(views)} left-out photographs, {n_good} of which localize"
            problem = (
                f"adapting needs {LEAST_OF_A_KIND} left-out photographs that localize and {LEAST_OF_A_KIND} that do not"
            )
            raise MapError(problem, path=source, value=value, fix="Use the weights that ship.")
        value = f"{len(views)} views at {n_locations} locations, {n_good} of which localize"
        problem = (
            f"adapting needs {LEAST_VIEWS} labelled views at {LEAST_LOCATIONS} locations, of which {LEAST_OF_A_KIND} "
            f"localize and {LEAST_OF_A_KIND} do not"
        )
        raise TableError(problem, path=source, value=value, fix="Sample more viewpoints, or give more minutes.")


def _save(target: _Target, points: Float, adapted: Adapted, views: LocalizedViews, gain: Gain) -> None:
    import torch

    from wheretolook.scorers.adapted.network import AdaptedNetwork
    from wheretolook.scorers.set.network import SetNetwork
    from wheretolook.training.trained_network import TrainedNetwork

    base = TrainedNetwork.load(target.weights, SetNetwork, "set")
    correction = adapted.adaptation
    some = points[np.arange(min(_MAX_SIGNATURE, len(points))) * len(points) // max(1, min(_MAX_SIGNATURE, len(points)))]
    sizes = len(correction.weights), len(some)
    kernel = base.scale, base.offset, correction.length_m, correction.sharpness
    network = AdaptedNetwork(base.network, *kernel, *sizes)
    for name, values in (("centers", correction.centers), ("axes", correction.axes), ("weights", correction.weights)):
        setattr(network, f"support_{name}", torch.from_numpy(np.array(values, dtype=np.float64)))
    network.place = torch.from_numpy(np.array(some, dtype=np.float64))
    trained = TrainedNetwork("adapted", network, base.camera, correction.scale, correction.offset, base.training_range)
    about = {"scene": target.name, "views": len(views), "photographs": int((views.photograph >= 0).sum())}
    about |= {"weights_sha256": fingerprint(target.weights)}
    trained.save(target.path, {**about, "before": gain.before, "after": gain.after})


def _log(options: Adapt, target: _Target, adapted: Adapted, views: LocalizedViews, gain: Gain, is_better: bool) -> None:
    from wheretolook.tracking.runs import log, start_run

    params = {"dataset": target.dataset, "scene": target.name, "weights": target.weights, "views": len(views)}
    params |= {"photographs": int((views.photograph >= 0).sum())}
    params |= {"length_m": adapted.length_m, "amplitude": adapted.amplitude, "scale": adapted.adaptation.scale}
    metrics = {**gain.after, **{f"{name}_before": value for name, value in gain.before.items()}}
    metrics |= {"better": float(is_better), "log_loss_less": gain.log_loss_less[0]}
    with start_run(options.tracking, target.name, "adapt", params) as (client, run):
        log(client, run, metrics=metrics)
        client.log_artifact(run, str(target.path.with_suffix(".md")))
        if is_better:
            client.log_artifact(run, str(target.path))
