"""`wheretolook adapt`: weights adapted to one scene, by views that were localized there."""

from __future__ import annotations

import shutil
import time
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from wheretolook.commands.check import check_name, folder_of_check, hold_out_photographs, knows_photographs
from wheretolook.commands.options import (
    LabelOptions,
    Log,
    Progress,
    SceneOptions,
    extractor_of,
    ignore_progress,
    open_scene,
    refuse_release,
    scene_job,
)
from wheretolook.dataset.dataset_lock import reading
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.scene import ColmapFiles, Scene
from wheretolook.mapping.colmap_model import read_model
from wheretolook.mapping.config import FrameOptions, place_name
from wheretolook.mapping.map_frame import find_frame
from wheretolook.scorers.weights import resolve_weights
from wheretolook.tracking import TrackingConfig, check_store, kept_if_not_logged, log as log_to_run, start_run
from wheretolook.utils.errors import ConfigError, MapError, SceneError, TableError, check_positive, check_range, reject
from wheretolook.utils.files import missing_folders, remove_if_empty, storage_errors, write_text
from wheretolook.utils.processes import hold

if TYPE_CHECKING:
    import pandas as pd

    from wheretolook.evaluation.adaptation import Gain
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.scorers.adapted.calibration import Adapted, LocalizedViews
    from wheretolook.visibility.occlusion import OcclusionModel

FOLDER = "adapted"  # of a dataset: adapted weights, and what they have gained


@dataclass(frozen=True)
class _Target:
    """What weights are adapted to, the weights to start from, and the file of the adapted ones."""

    name: str
    dataset: str  # its name; empty for a COLMAP model
    weights: Path
    path: Path


@dataclass(frozen=True, kw_only=True)
class Adapt(SceneOptions, LabelOptions, FrameOptions):
    """Adapt the bundled weights to one scene by views localized there; keep them only if they are better.

    Uses the photographs of a COLMAP model (--map) or of a scene made of photographs, held out in blocks as `wheretolook
    check` does; and a scene's labels, or, without labels but with a mesh, as many of its viewpoints as can be labelled
    in the given minutes; run again, it continues with more. The weights are for this scene alone:

      wheretolook select --map sparse/0 --weights data/checks/mymap/adapted.safetensors --at 1,2,1.4 --out views.csv

    Examples:
      wheretolook adapt --map sparse/0 --database database.db
      wheretolook adapt --config configs/demo.yaml --scene apartment-000 --minutes 5

    Args:
        scene: name of the scene; may be empty if the dataset has only one.
        map: instead of a scene: folder of a COLMAP model, in metres with z up, whose photographs are held out.
        images: folder of the map's photographs, to extract their features again.
        database: features that the map was made from: COLMAP's `database.db`, or hloc's in HDF5. Empty for those next to
            the map.
        weights: file of weights of `set` to start from; empty for the bundled ones.
        out: file of weights to write; empty for `<data>/<name>/adapted/<scene>.safetensors`, of a map
            `<data>/checks/<map>/adapted.safetensors`.
        minutes: time for labelling rendered views, if the scene has a mesh and its views have no labels yet.
        seed: decides which locations are labelled first, and which views are held out together.
        tracking: where MLflow keeps its runs.
    """

    SHORT: ClassVar = {"engine": "label.engine"}
    GROUPS: ClassVar = {"adapt": ""}

    scene: str = ""
    map: Path | None = None
    images: Path | None = None
    database: Path | None = None
    weights: Path | None = None
    out: Path | None = None
    minutes: float = 10.0
    seed: int = 0
    tracking: TrackingConfig = field(default_factory=TrackingConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        reject(
            (bool(self.scene) and self.map is not None, "weights are adapted to either --scene or --map", self.scene),
            (bool(self.images and self.database), "features come from either --database or --images", str(self.images)),
        )
        check_positive("minutes", self.minutes)
        check_range("seed", self.seed, 0)

    def run(self, log: Log = print, progress: Progress = ignore_progress) -> Path | None:
        """Adapt a set scorer to one scene, or to a COLMAP map of photographs, by views that were localized there.

        Cross-validated measures before and after go to `<scene>.md` and an MLflow run. The weights are kept if the
        probabilities are better by more than the 95 % interval and the choice of views is not worse by more than it;
        with both kinds of views, those of the photographs must not be worse by more than it. Returns the file of the
        adapted weights, or None if they are not better.

        Raises:
            ConfigError: no such scene. SceneError: it has neither labels, nor a mesh to render, nor photographs.
            TableError: it has too few viewpoints or photographs, or too few that localize, or that do not.
            WeightsError: the weights to start from are not of the method `set`.
            MapError: the map of a scene is not in metres, or its photographs' features are not known.
        """
        frame = self.frame_options()
        appearance = self.map and self.label.appearance
        changes = self.label.changes
        reject(
            (self.map is None and frame != FrameOptions(), "the map's scale and up belong to --map", vars(frame)),
            (bool(appearance), "label.appearance is for renders, not for the photographs of --map", appearance),
            (bool(changes), "label.changes is for the label command, whose labels are then adapted to", changes),
        )
        if self.map is not None:
            return self._adapt_map(self.map, log, progress)
        refuse_release(self.root)
        with reading(self.root, "adapt", FOLDER):
            dataset = Dataset.load(self.root)
            files = _scene(dataset, self.scene)
            scene = open_scene(self, files)
            path = dataset.root / FOLDER / f"{files.name}.safetensors"
            target = self._target(files.name, path, dataset)
            has_photographs = knows_photographs(files, self.images, self.database)
            table = self._labelled(files, scene, has_photographs, log)
            views = None
            if table is not None:
                from wheretolook.evaluation.adaptation import labelled_views

                views = labelled_views(files, scene, table, target.weights)
            if has_photographs:
                try:
                    name = check_name(self, files)
                    held_out, _ = self._held_out(files.map, name, scene.occlusion, target.weights, log)
                    views = held_out if views is None else views.joined(held_out)
                except MapError as error:
                    if views is None:
                        raise
                    log(f"{files.name}: its photographs are not used: {error}")
            assert views is not None
            _check_enough(views, files.map if table is None else files.table)
            whole = scene.localization_map if scene.map.has_photographs else files.localization_map(device=scene.device)
            return self._fit(target, views, whole, log, progress)

    def _adapt_map(self, model: Path, log: Log, progress: Progress) -> Path | None:
        """Adapt to a COLMAP map by its photographs only."""
        name = place_name(model)
        target = self._target(name, folder_of_check(self.data, name) / "adapted.safetensors")
        occlusion = "none" if self.occlusion.model == "none" else "hidden-points"
        reconstruction = read_model(model)
        frame = find_frame(model, reconstruction, self.frame_options())
        log(f"{name}: {'; '.join((frame.describe(), *frame.doubts))}")
        scene = Scene.of_colmap(ColmapFiles(model), None, occlusion, device=self.warp_device)
        views, whole = self._held_out(model, name, scene.occlusion, target.weights, log)
        _check_enough(views, model)
        with hold(target.path.with_name(f".{target.path.name}.lock"), "adapt"):
            return self._fit(target, views, whole, log, progress)

    def _target(self, name: str, path: Path, dataset: Dataset | None = None) -> _Target:
        """Return what is adapted, after checks that fail before the work; `path` is the default of `adapt.out`."""
        features = "" if dataset is None else dataset.features
        weights = resolve_weights("set", self.weights, features)
        assert weights is not None
        path = self.out or path
        if path.suffix != ".safetensors" or path.is_dir() or path.resolve() == weights.resolve():
            fix = "Give --out the name of another file that ends in .safetensors."
            raise ConfigError("adapted weights cannot be written to this path", path=path, fix=fix)
        created = missing_folders(path)
        with storage_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        remove_if_empty(created)
        check_store(self.tracking)
        return _Target(name, "" if dataset is None else dataset.name, weights, path)

    def _held_out(
        self, model: Path, name: str, occlusion: OcclusionModel, weights: Path, log: Log
    ) -> tuple[LocalizedViews, LocalizationMap]:
        """Return a map's photographs, held out in blocks that `wheretolook check` shares, and the whole map."""
        from wheretolook.holdout.scores import photographed_views, whole_map

        log(f"{name}: holding out blocks of photographs")
        photographs, held_out = hold_out_photographs(
            self, "adapt", model, name, self.frame_options(), self.images, self.database
        )
        views = photographed_views(photographs, held_out, weights, occlusion, self.warp_device)
        return views, whole_map(photographs, occlusion, self.warp_device)

    def _fit(
        self, target: _Target, views: LocalizedViews, whole: LocalizationMap, log: Log, progress: Progress
    ) -> Path | None:
        """Adapt to localized views; keep the weights if they are better, report and log the gain."""
        from wheretolook.evaluation.adaptation import compare_log_odds, gain_markdown, save_adapted
        from wheretolook.scorers.adapted.calibration import adapt as fit

        name = target.name
        path = target.path
        seed = self.seed
        photographs = views.photograph >= 0
        kinds = {"rendered views": ~photographs, "held-out photographs": photographs}
        counts = " and ".join(f"{rows.sum():,} {kind}" for kind, rows in kinds.items() if rows.any())
        log(f"{name}: fitting to {counts}, {views.good.mean():.0%} of which localize")
        adapted = fit(views, seed)

        def gain_of(rows: NDArray[np.bool_]) -> Gain:
            some = views.rows(rows)
            return compare_log_odds(
                some.log_odds, adapted.held_out[rows], some.good, some.place, some.centers, seed, some.blocks
            )

        gain = gain_of(np.ones(len(views), dtype=bool))
        text = gain_markdown(gain)
        is_better = gain.is_better
        if photographs.any() and not photographs.all():
            of_photographs = gain_of(photographs)
            is_better = is_better and not of_photographs.is_worse
            text += f"\nPhotographs only:\n\n{gain_markdown(of_photographs)}"
        write_text(path.with_suffix(".md"), f"# {name}: adapted by {counts}\n\n{text}")
        if is_better:
            save_adapted(path, target.weights, whole, adapted, {"scene": name, **_counts(views)}, gain)
            log(f"{text}\n{name}: the adapted weights are better -> {path}")
        else:
            log(f"{text}\n{name}: adapting does not make the weights better here: use {target.weights}")
            if self.out is None:
                path.unlink(missing_ok=True)  # of an earlier run, by other labels
        with kept_if_not_logged(f"the gain of adapting, {path.with_suffix('.md')},"):
            self._log_gain(target, adapted, views, gain, is_better)
        progress(1)
        return path if is_better else None

    def _log_gain(self, target: _Target, adapted: Adapted, views: LocalizedViews, gain: Gain, is_better: bool) -> None:
        params = {"dataset": target.dataset, "scene": target.name, "weights": target.weights, **_counts(views)}
        params |= {"scale": adapted.scale, "offset": adapted.offset}
        metrics = {**gain.after, **{f"{name}_before": value for name, value in gain.before.items()}}
        metrics |= {"better": float(is_better), "log_loss_less": gain.log_loss_less[0]}
        report = target.path.with_suffix(".md")
        with start_run(self.tracking, target.name, "adapt", params) as (client, run):
            log_to_run(client, run, metrics=metrics, files=(report, target.path) if is_better else (report,))

    def _labelled(self, files: SceneFolder, scene: Scene, has_photographs: bool, log: Log) -> pd.DataFrame | None:
        """Return the scene's labelled viewpoints: all if `label` has run, else those that the time allows.

        None where there are only photographs.
        """
        if files.stage_cache("label").stored_key is not None:
            shutil.rmtree(files.adapt_shards, ignore_errors=True)  # of views that have labels now
            return files.read_table()
        has_mesh = files.mesh.is_file()
        if has_mesh and files.stage_cache("sample").stored_key is not None:
            return self._label(files, scene, log)
        if has_photographs:
            log(f"{files.name}: no viewpoints to label, so only photographs are used")
            return None
        if has_mesh:
            problem = "`wheretolook sample` has not been run for this scene since its input was made"
            raise TableError(problem, path=files.folder, fix="Run `wheretolook sample`.")
        problem = "this scene has neither labels, nor a mesh to render views of, nor the photographs of its map"
        fix = "Give --database or --images, the map's photographs, or use the bundled weights."
        raise SceneError(problem, path=files.folder, fix=fix)

    def _label(self, files: SceneFolder, scene: Scene, log: Log) -> pd.DataFrame:
        """Label views for `adapt.minutes`, one location after the other in random order; a later run continues."""
        import pandas as pd

        from wheretolook.localization.labeller import LabelTask, label_scenes

        minutes = self.minutes
        table = files.read_table()
        if table.empty:
            return table
        ids, row = np.unique(table["location_id"].to_numpy(), return_inverse=True)
        order = np.random.default_rng(self.seed).permutation(len(ids))[row.reshape(-1)]
        table = table.iloc[np.argsort(order, kind="stable")].reset_index(drop=True)
        job = scene_job(files, self.label, extractor_of(files, self.extractor), scene.device)
        tasks = []
        n_of_task = 128  # the time is checked after each task
        for begin in range(0, len(table), n_of_task):
            part = table.iloc[begin : begin + n_of_task]
            tasks.append(LabelTask(f"{files.name} {begin}", job, part, files.adapt_shards / f"{begin:06}"))
        log(f"{files.name}: labelling up to {len(table):,} views, for {minutes:g} minutes at most")
        done: dict[str, pd.DataFrame] = {}
        end = None  # the time counts from the first views that are labelled now, not read from an earlier run
        with closing(label_scenes(tasks, self.label)) as results:
            for labelled in results:
                done[labelled.task.name] = labelled.table
                if labelled.seconds and end is None:
                    end = time.monotonic() + 60 * minutes - sum(labelled.seconds.values()) / self.n_workers
                if end is not None and time.monotonic() >= end:
                    break
        labelled_table = pd.concat([done[task.name] for task in tasks if task.name in done], ignore_index=True)
        if len(labelled_table) < len(table):
            log(f"{files.name}: {len(labelled_table):,} of {len(table):,} views labelled; run again to label more")
        return labelled_table


def _scene(dataset: Dataset, name: str) -> SceneFolder:
    if name or not dataset.scenes:
        return dataset.scene(name)
    if len(dataset.scenes) > 1:
        names = ", ".join(scene.name for scene in dataset.scenes[:10])
        raise ConfigError("weights are adapted to one scene", path=dataset.root, fix=f"Give --scene: {names}.")
    return dataset.scenes[0]


def _check_enough(views: LocalizedViews, source: Path) -> None:
    """Raise TableError if there are too few views of either label to fit to."""
    n_good = int(views.good.sum())
    rendered = bool((views.photograph < 0).any())
    counts = (len(views), len(np.unique(views.group)), n_good, len(views) - n_good)
    needed = (rendered * 100, rendered * 10, 10, 10)
    if np.less(counts, needed).any():
        views_needed, places_needed, good_needed, bad_needed = needed
        problem = (
            f"adapting needs {views_needed} views at {places_needed} locations or blocks, of which {good_needed} "
            f"localize and {bad_needed} do not"
        )
        fix = "Sample more viewpoints, or give more minutes." if rendered else "Use the bundled weights."
        raise TableError(problem, path=source, value=counts, fix=fix)


def _counts(views: LocalizedViews) -> dict[str, object]:
    return {"views": len(views), "photographs": int((views.photograph >= 0).sum())}
