"""The stages, one function each, for Python, notebooks and the command line alike.

A stage works through the scenes of an experiment and leaves its result on disk with a stamp that says what it was made
from. Called again, it reuses what is there if its settings and inputs are the same, and otherwise makes it anew.
"""

from __future__ import annotations

import shutil
import time
import zlib
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from wheretolook.config import Experiment
from wheretolook.dataset import Dataset, SceneFolder, Split, write_json
from wheretolook.errors import MapError, SceneError
from wheretolook.stage_inputs import (
    dataset_after,
    existing,
    extractor_of,
    mesh_fingerprint,
    naming_scene,
    refuse_release,
)
from wheretolook.stamps import forget_stamp, is_done, read_stamp, stage_key, write_stamp
from wheretolook.table import write_table

if TYPE_CHECKING:
    import pandas as pd

    from wheretolook.learning.training import TrainedModel
    from wheretolook.planning import ViewpointMap
    from wheretolook.planning.path_planning import PlannedPath

Say = Callable[[str], None]
Tick = Callable[[float], None]


def make_scenes(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Dataset:
    """Stage 1: a textured mesh for every scene, `<scene>/mesh.glb`, and the dataset's description.

    Raises:
        SceneError: a mesh of one's own cannot be used, or two scenes have the same name.
        ConfigError: the dataset's folder holds a release.
    """
    from wheretolook.scenes.loading import load_mesh, save_glb
    from wheretolook.scenes.procedural import generate_apartment

    config, root = experiment.scenes, experiment.root
    refuse_release(root)
    numbers: dict[Split, int] = {"train": config.train, "val": config.val, "test": config.test}
    splits = [split for split, number in numbers.items() for _ in range(number)]
    sources: dict[SceneFolder, Callable[[], Any]] = {}
    keys: dict[SceneFolder, Any] = {}
    for index, split in enumerate(splits):
        seed = config.seed + index
        scene = SceneFolder(root / f"apartment-{seed:03d}", split)
        sources[scene] = partial(generate_apartment, config.apartment, seed, device=experiment.warp_device)
        keys[scene] = [config.apartment.key(), seed]
    for source in config.meshes:
        scene = SceneFolder(root / source.scene_name, source.split)
        if scene.name in {other.name for other in sources}:
            raise SceneError("two scenes have the same name", path=source.path, value=scene.name, fix="Give it a name.")
        sources[scene] = partial(load_mesh, source.path, up=source.up)
        keys[scene] = [mesh_fingerprint(source.path), source.up]

    for scene, make in sources.items():
        key = stage_key("scenes", keys[scene])
        if not is_done(scene, "scenes", key, scene.mesh):
            mesh = make()
            scene.folder.mkdir(parents=True, exist_ok=True)
            save_glb(mesh, scene.mesh)
            write_stamp(scene, "scenes", key)
            say(f"{scene.name}: {len(mesh.triangles):,} triangles -> {scene.mesh}")
        else:
            say(f"{scene.name}: reusing {scene.mesh}")
        tick(1)
    dataset = Dataset(root, experiment.camera, tuple(sources))
    if (root / "dataset.json").is_file() and Dataset.load(root).camera != experiment.camera:
        for scene in dataset.scenes:  # what was made with another camera is no longer valid
            write_stamp(scene, "scenes", read_stamp(scene, "scenes") or "")
    dataset.save()
    return dataset


def make_maps(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Dataset:
    """Stage 2: a COLMAP model of every scene with its landmarks' attributes, `<scene>/map/`.

    With `map.photographs.images`, of a scene made of the photographs there; see `map_photograph_scene`.

    Raises:
        SceneError, MapError: a mesh cannot be read, or no landmark could be triangulated.
    """
    if experiment.map.photographs.images is not None:
        from wheretolook.photograph_scenes import map_photograph_scene

        refuse_release(experiment.root)
        return map_photograph_scene(experiment, say, tick)
    from wheretolook.mapping.building import build_map
    from wheretolook.rendering import MeshRaycaster, WarpRenderer
    from wheretolook.scenes.free_space import FreeSpace
    from wheretolook.scenes.loading import load_mesh

    dataset, device = dataset_after(experiment, "scenes"), experiment.warp_device
    settings = {name: value for name, value in asdict(experiment.map).items() if name != "photographs"}
    for scene in dataset.scenes:
        seed = zlib.crc32(scene.name.encode()) % 2**31  # the scene's own, whichever scenes are beside it
        key = stage_key("map", [settings, asdict(experiment.scenes.free_space), asdict(dataset.camera), seed,
                           existing(scene.mesh, SceneError, "scenes")])  # fmt: skip
        model = [scene.map / name for name in ("cameras.bin", "images.bin", "points3D.bin")]
        if not is_done(scene, "map", key, scene.landmarks, *model):
            mesh = load_mesh(scene.mesh)
            raycaster = MeshRaycaster(mesh, device)
            with naming_scene(scene.mesh):
                report = build_map(
                    mesh,
                    WarpRenderer(mesh, device),
                    FreeSpace(mesh, experiment.scenes.free_space, device),
                    dataset.camera,
                    experiment.map,
                    seed=seed,
                    out_dir=scene.map,
                    workers=experiment.n_workers,
                    raycaster=raycaster,
                    device=device,
                )
            write_stamp(scene, "map", key)
            say(f"{scene.name}: {report.n_landmarks:,} landmarks from {report.n_registered} images, median "
                f"{report.median_distance_to_mesh_cm:.2f} cm from the mesh -> {scene.map}")  # fmt: skip
        else:
            say(f"{scene.name}: reusing {scene.map}")
        tick(1)
    return dataset


def sample(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Dataset:
    """Stage 3: viewpoints and which landmarks their locations see, `<scene>/viewpoints.parquet` and `occlusion.npz`.

    Every voxel's free location is looked from in every direction; the landmarks it sees are counted exactly.

    A scene of photographs is free near where these were taken, and occluded by hidden-point removal.

    Raises:
        SceneError: no location is free. MapError: there is no map, or one without a scale.
    """
    from wheretolook.grid import VoxelGrid
    from wheretolook.mapping.landmarks import Landmarks
    from wheretolook.photograph_scenes import is_photographed, occlusion_without_mesh, require_metres
    from wheretolook.sampling import free_locations, sample_viewpoints
    from wheretolook.scene_space import space_and_occlusion

    dataset, device = dataset_after(experiment, "map"), experiment.warp_device
    for scene in dataset.scenes:
        chosen = {name: value for name, value in asdict(experiment.sample).items() if name != "memory_gb"}
        chosen["max_directions"] = experiment.sample.directions_of(scene.split)
        occlusion_config, space_config, source = experiment.occlusion, asdict(experiment.scenes.free_space), scene.mesh
        if photographed := is_photographed(scene):
            require_metres(scene, experiment.map.photographs.assume_metric)
            occlusion_config, source = occlusion_without_mesh(experiment.occlusion), scene.mapping_cameras
            space_config = asdict(experiment.scenes.mapped_space)
        key = stage_key("sample", [chosen, occlusion_config.settings(), space_config, asdict(dataset.camera),
                                   existing(source, SceneError, "map" if photographed else "scenes"),
                                   existing(scene.landmarks, MapError, "map")])  # fmt: skip
        if not is_done(scene, "sample", key, scene.table, scene.occlusion):
            landmarks = Landmarks.load(scene.landmarks)
            with naming_scene(source):
                space, occlusion = space_and_occlusion(
                    scene, dataset.camera, experiment, occlusion_config, free_by_tsdf=False
                )
                grid = VoxelGrid.over(space.bounds, experiment.sample.grid)
                free = free_locations(grid, space)
                # depth images that have not seen all of the scene may put free space behind surfaces
                free = free[~occlusion.inside_geometry(grid.centers()[free])]
                table, stored = sample_viewpoints(
                    grid, free, landmarks, dataset.camera, occlusion, experiment.sample, device,
                    progress=f"sample {scene.name}", split=scene.split,
                )  # fmt: skip
            stored.save(scene.occlusion)
            write_table(table, scene.table)
            write_stamp(scene, "sample", key)
            say(f"{scene.name}: {len(table):,} viewpoints at {table['location_id'].nunique()} of {len(free)} free "
                f"locations -> {scene.table}")  # fmt: skip
            if photographed and occlusion_config != experiment.occlusion:
                say(f"{scene.name}: occlusion by {occlusion_config.model}, as there is no mesh")
        else:
            say(f"{scene.name}: reusing {scene.table}")
        tick(1)
    return dataset


def label(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Dataset:
    """Stage 4: every viewpoint rendered and localized; status and errors into `<scene>/viewpoints.parquet`.

    Resumes after an interruption, see `wheretolook.labelling.label_scenes`. How the labels came out goes to
    `<dataset>/results/labels.*` and an MLflow run.

    Raises:
        SceneError: a mesh is missing, or a scene is known from photographs alone.
    """
    from wheretolook.labelling import LabelTask, label_scenes
    from wheretolook.labelling.labeller import storing
    from wheretolook.labelling.report import LABELS_MD, log_labels
    from wheretolook.labelling.shard import SceneJob
    from wheretolook.photograph_scenes import refuse_labelling
    from wheretolook.table import is_good

    def report(scene: SceneFolder, table: pd.DataFrame) -> None:
        say(f"{scene.name}: {is_good(table).mean():.0%} of {len(table):,} viewpoints localize within 5 cm and 0.4 "
            f"degrees -> {scene.table}")  # fmt: skip
        tick(1)

    dataset, config = dataset_after(experiment, "sample"), experiment.label
    scenes: dict[str, tuple[SceneFolder, str]] = {}
    tasks: list[LabelTask] = []
    for scene in dataset.scenes:
        refuse_labelling(scene)
    for scene in sorted(dataset.scenes, key=lambda scene: scene.split == "train"):  # those to evaluate on come first
        table, extractor = scene.read_table(), extractor_of(scene)
        key = stage_key("label", [asdict(config.localizer), asdict(extractor), asdict(dataset.camera),
                             existing(scene.mesh, SceneError, "scenes"),
                             existing(scene.landmarks, MapError, "map"), read_stamp(scene, "sample"),
                             *(["store_matches"] if config.store_matches else [])])  # fmt: skip
        shards = scene.folder / "shards"
        if is_done(scene, "label", key, scene.table):
            shutil.rmtree(shards, ignore_errors=True)  # killed before it could remove them
            report(scene, table)
            continue
        scenes[scene.name] = scene, key
        job = SceneJob(scene.mesh, scene.landmarks, dataset.camera, config.localizer, extractor, experiment.warp_device,
                       config.store_matches)  # fmt: skip
        tasks.append(LabelTask(scene.name, job, table, shards))
    summary = dataset.root / "results" / LABELS_MD
    seconds: dict[str, float] = {}
    start, replacing = time.monotonic(), False
    with closing(label_scenes(tasks, config, progress=bool(tasks))) as results:  # so that Ctrl-C here ends the workers
        for labelled in results:
            scene, key = scenes[labelled.task.name]
            if not replacing:  # until all are labelled alike, and that is logged, nothing may use the labels
                replacing = True
                summary.unlink(missing_ok=True)
                for other, _ in scenes.values():
                    forget_stamp(other, "label")
            with storing(scene.table):
                write_table(labelled.table, scene.table)
                write_json(scene.label_manifest, labelled.manifest)
                write_stamp(scene, "label", key)
            shutil.rmtree(labelled.task.shards, ignore_errors=True)
            for step, spent in labelled.seconds.items():
                seconds[step] = seconds.get(step, 0.0) + spent
            report(scene, labelled.table)
    if tasks:
        seconds["wall"] = time.monotonic() - start
    if not summary.is_file():
        try:
            log_labels(dataset, experiment.tracking, seconds)
        except BaseException:
            summary.unlink(missing_ok=True)
            raise
    if tasks:
        say("seconds: " + ", ".join(f"{step} {spent:.1f}" for step, spent in seconds.items())
            + " (workers' time in each step, added up; then the clock's)")  # fmt: skip
    return dataset


def train(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Sequence[TrainedModel]:
    """Stage 5: one network for each input variant, `<dataset>/weights/`, and an MLflow run for each."""
    from wheretolook.learning.training import train as train_variants

    config = experiment.train
    if experiment.warp_device == "cpu":
        config = replace(config, accelerator="cpu")
    models = train_variants(dataset_after(experiment, "label"), config, experiment.tracking)
    for model in models:
        say(f"{model.variant}: reusing {model.path}" if model.reused else f"{model.variant}: -> {model.path}")
    tick(1)
    return models


def evaluate(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> pd.DataFrame:
    """Stage 6: the score table of all methods on the test scenes, `<dataset>/results/`, and nested MLflow runs."""
    from wheretolook.evaluation import evaluate as evaluate_methods

    dataset = dataset_after(experiment, "label")
    scores = evaluate_methods(
        dataset, experiment.evaluate, experiment.tracking, device=experiment.warp_device, occlusion=experiment.occlusion
    )
    tick(1)
    return scores


def viewpoint_map(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> dict[str, ViewpointMap]:
    """For planners: every direction scored at every free voxel of a scene, `<scene>/viewpoint-map/`.

    Needs the map stage only. It is built anew each time.

    Returns:
        The viewpoint map of each scene asked for, by the scene's name.

    Raises:
        ConfigError: no such scene or method, or the method needs weights. WeightsError: the weights cannot be used.
        SceneError: there is no mesh, or no voxel is free. MapFormatError: something else is where the map belongs.
    """
    from wheretolook.photograph_scenes import is_photographed, occlusion_without_mesh
    from wheretolook.planning.scene_map import default_weights, scene_viewpoint_map
    from wheretolook.scene_space import space_and_occlusion

    dataset, config = dataset_after(experiment, "map"), experiment.viewpoint_map
    if not config.method and config.weights is None and (weights := default_weights(dataset, say)) is not None:
        say(f"scored by {weights}")
        config = replace(config, weights=weights)
    built: dict[str, ViewpointMap] = {}
    for scene in [dataset.scene(config.scene)] if config.scene else dataset.scenes:
        name = scene.name
        photographed = is_photographed(scene)
        hides = occlusion_without_mesh(experiment.occlusion) if photographed else experiment.occlusion
        with naming_scene(scene.map if photographed else scene.mesh):
            space, occlusion = space_and_occlusion(scene, dataset.camera, experiment, hides)
            found = scene_viewpoint_map(scene, dataset.camera, config, space, occlusion, experiment.warp_device)
        folder = config.out or scene.folder / "viewpoint-map"
        found.save(folder)
        built[name] = found
        n_rows, n_directions = found.scores.shape
        say(f"{name}: {n_directions} directions at {n_rows} free voxels of {len(found.grid)}, scored by "
            f"{found.origin.scorer} -> {folder}")  # fmt: skip
        tick(1)
    return built


def plan(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> PlannedPath:
    """A path through a scene on which the camera localizes, `<scene>/path/path.{csv,png,gif}`; needs the map stage.

    Raises:
        ConfigError: no such scene or method, no start or goal, no weights, or Rerun is asked for and not installed.
        PlanningError: the start or the goal is not free, or no path was found. WeightsError: weights cannot be used.
        SceneError, MapError: the scene has no free place, or no map with a scale.
    """
    from wheretolook.planning.plan_stage import plan_scene

    path = plan_scene(dataset_after(experiment, "map"), experiment, say)
    tick(1)
    return path


def compare_paths(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> pd.DataFrame:
    """Paths planned by several methods, rendered and localized: `<dataset>/results/paths.{csv,md,png}`, MLflow runs.

    Needs the map stage only. What was planned and localized before is used again.

    Returns:
        `wheretolook.planning.path_report.summarize_paths`.

    Raises:
        ConfigError: no such scene or method, or no weights. WeightsError: the weights cannot be used.
        SceneError: a scene has no mesh, or too little room for starts and goals.
    """
    from wheretolook.planning.path_stage import compare_scenes

    summary = compare_scenes(dataset_after(experiment, "map"), experiment, extractor_of, say)
    tick(1)
    return summary


def release(experiment: Experiment, say: Say = print, tick: Tick = lambda work: None) -> Dataset:
    """Publish a labelled dataset: a compact copy of it, `<data>/<release_name>/`, and in the end its card.

    For any dataset but a release this makes the copy. For the copy itself, once networks are trained on it, it chooses
    the weights that ship, evaluates them and writes the card. Either can be done again.

    Raises:
        WeightsError: no weights, or such that do not fit the release.
        StorageError: it is not smaller than 16 MB.
        ConfigError: another dataset lies where the copy belongs.
    """
    from wheretolook.evaluation.results import SCORES_CSV, VARIANTS_CSV
    from wheretolook.learning.runs import keep_histories
    from wheretolook.learning.weights import weights_kind
    from wheretolook.release import (
        choose_weights_to_ship,
        copy_dataset,
        is_release,
        ship_weights,
        size_text,
        sizes,
        trained_weights,
    )
    from wheretolook.release_card import write_card

    dataset = dataset_after(experiment, "label")
    if not is_release(dataset):
        copy = copy_dataset(dataset, experiment)
        for scene, source in zip(copy.scenes, dataset.scenes, strict=True):
            stamp = read_stamp(source, "label")
            assert stamp is not None  # `_dataset` has seen it
            write_stamp(scene, "label", stamp)
        say(f"{len(copy.scenes)} scenes -> {copy.root}: {size_text(sizes(copy.root, weights=False))}")
        say("next: train on it, then `wheretolook release` with its own configuration")
        return copy
    # on the CPU, as those who have no GPU will do it
    on_cpu = replace(experiment, device="cpu", evaluate=replace(experiment.evaluate, weights=()))
    results = dataset.root / "results"
    if choose_weights_to_ship(dataset).shelved:  # all that were trained, before only the best are left
        methods = tuple(dict.fromkeys(weights_kind(path) for path in trained_weights(dataset)))
        evaluate(replace(on_cpu, evaluate=replace(on_cpu.evaluate, methods=methods, reference="")), say)
        shutil.copyfile(results / SCORES_CSV, results / VARIANTS_CSV)
    choice = ship_weights(dataset)
    compared = ", ".join(f"{name} {value:.4f}" for name, value in choice.precision.items())
    say(f"validation average precision: {compared}")
    say(f"the paper's network that ships, in half precision: {choice.network}; the best of all: {choice.best}")
    keep_histories(dataset, experiment.tracking)
    sizes(dataset.root)  # too large? then before the evaluation
    evaluate(on_cpu, say, tick)
    say(f"the card -> {write_card(dataset)}")
    say(size_text(sizes(dataset.root)))
    return dataset
