"""The whole line on two tiny apartments: from the command line, again, from the same seed, and after damage."""

import shutil
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pycolmap
import pytest

from fixed_fields import FAST, main, with_fields
from wheretolook.cli import parse_command
from wheretolook.commands.options import open_scene
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_files import read_table
from wheretolook.dataset.viewpoint_table import is_good, poses, with_first_labels
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import camera_centers
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.localization.shard import ShardWorker
from wheretolook.scorers.registry import scorers
from wheretolook.scorers.train_config import TrainConfig
from wheretolook.scorers.weights import load_scorer
from wheretolook.space.free_space import FreeSpace, TsdfSpace
from wheretolook.tracking import TrackingConfig, finished_runs, newest_run
from wheretolook.utils.errors import TableError
from wheretolook.utils.files import fingerprint, read_json_object
from wheretolook.visibility.occlusion import StoredOcclusion

pytestmark = pytest.mark.slow  # the whole line, several times over

EXPERIMENT = """\
name: tiny
camera: {width: 320, height: 240, focal_px: 160}
scenes:
  train: 1
  test: 1
mapping: {n_images: 24}
sample: {grid: [6, 6, 4], directions: 100, keep: 50, max_locations: 8, max_directions: 5}
label: {workers: 1, shard_size: 20}
train: {methods: [mlp-2d, mlp-2d+3d, set], mlp: {epochs: 2}, set: {epochs: 2, batch_size: 1}}
evaluate: {methods: [random, visible, bins, fisher-trace-exact, mlp, set]}
"""


def run(stage, folder, *options, **fields):
    """Run a stage with options, and fields of its dataclasses by their names with __ for points."""
    where = ["--config", str(folder / "tiny.yaml"), "--data", str(folder / "data"), "--device", "cpu"]
    values = {name.replace("__", "."): value for name, value in fields.items()}
    return main([stage, *where, "--tracking.folder", str(folder / "mlruns"), *options], {**FAST, **values})


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    (folder / "tiny.yaml").write_text(EXPERIMENT)
    assert run("demo", folder) == 0
    return folder


@pytest.fixture
def copy(demo, tmp_path):
    """A copy that may be damaged."""
    shutil.copytree(demo, tmp_path / "copy")
    return tmp_path / "copy"


def results(folder):
    return sorted(path for path in folder.glob("data/tiny/*/**/*") if path.is_file() and path.name != "stages.json")


def test_every_stage_leaves_its_result(demo):
    dataset = Dataset.load(demo / "data" / "tiny")
    assert [scene.split for scene in dataset.scenes] == ["train", "test"]
    for scene in dataset.scenes:
        table = scene.read_table()
        assert 0 < len(table) <= 40 and not table.isna()["status"].any()
        assert 0 < is_good(table, 0.25, 2.0).mean() < 1
        assert len(pycolmap.Reconstruction(scene.map).points3D) > 100
        assert not (scene.folder / "shards").exists()
    scores = pd.read_csv(dataset.root / "results" / "scores.csv")
    rules = {"random", "visible", "bins", "fisher-trace-exact", "oracle"}
    assert {*rules, "mlp-2d", "mlp-2d+3d", "set", "set that ships"} == set(scores["method"])
    assert (dataset.root / "results" / "overview.png").stat().st_size > 10_000


def test_run_again_it_reuses_what_is_there(demo, capsys):
    before = {path: path.stat().st_mtime_ns for path in results(demo)}
    assert run("demo", demo) == 0
    assert {path: path.stat().st_mtime_ns for path in results(demo)} == before
    assert len([*finished_runs(TrackingConfig(str(demo / "mlruns")), "evaluate")]) == 1
    assert "[evaluate] reusing" in capsys.readouterr().out


def test_all_methods_are_trained_and_compared(copy):
    methods = EvaluateConfig().methods
    learned = TrainConfig().methods
    assert run("train", copy, "--train.methods", f"[{','.join(learned)}]") == 0
    assert run("evaluate", copy, "--evaluate.methods", f"[{','.join(methods)}]") == 0
    scores = pd.read_csv(copy / "data" / "tiny" / "results" / "scores.csv")
    rules = {name for name in methods if not scorers()[name].weights}
    assert {*learned, *rules} <= {*scores["method"]}


@pytest.mark.parametrize("workers", ["1", "2"])
def test_the_same_seed_gives_the_same_bytes(demo, tmp_path, workers, request):
    if workers == "1":
        request.getfixturevalue("in_this_process")
    (tmp_path / "tiny.yaml").write_text(EXPERIMENT)
    for stage in ("scenes", "map", "sample", "label"):
        assert run(stage, tmp_path, "--scenes.test", "0", "--label.workers", workers, "--label.shard_size", "7") == 0
    for name in ("mesh.glb", "map/points3D.bin", "map/landmarks.npz", "occlusion.npz", "viewpoints.parquet"):
        ours, theirs = (folder / "data" / "tiny" / "apartment-000" / name for folder in (tmp_path, demo))
        assert fingerprint(ours) == fingerprint(theirs), name


@pytest.mark.usefixtures("in_this_process", "no_pictures_here")
def test_a_changed_setting_remakes_what_depends_on_it(copy):
    scene = Dataset.load(copy / "data" / "tiny").scenes[0]
    mesh = fingerprint(scene.mesh)
    table = scene.read_table()
    assert run("sample", copy, "--sample.seed", "5") == 0
    assert fingerprint(scene.mesh) == mesh
    assert (scene.read_table()["status"] == "unlabelled").all()
    assert run("sample", copy) == 0 and run("label", copy) == 0
    pd.testing.assert_frame_equal(scene.read_table(), table)


@pytest.mark.usefixtures("in_this_process", "no_pictures_here")
def test_matches_are_stored_on_request_and_removed_with_their_labels(copy):
    scene, *_ = Dataset.load(copy / "data" / "tiny").scenes
    before = scene.table.read_bytes()
    stored = ("label", copy, "--label.store_matches", "true")
    assert run(*stored) == 0  # the finished labels do not have them
    table = read_table(scene.table, matches=True)
    assert (table["inlier_rows"].map(len) == table["n_inliers"]).all()
    assert all(np.isin(*rows).all() for rows in table[["inlier_rows", "matched_rows"]].itertuples(index=False))
    assert np.concatenate(table["matched_rows"].to_list()).max() < len(np.load(scene.landmarks)["ids"])
    assert run("label", copy) == 0 and scene.table.read_bytes() == before
    assert run(*stored) == 0 and run("sample", copy, "--sample.seed", "5") == 0
    with pytest.raises(TableError):
        read_table(scene.table, matches=True)


@pytest.mark.usefixtures("in_this_process", "no_pictures_here")
def test_appearances_replace_the_labels_and_are_removed_again(copy):
    scene, *_ = Dataset.load(copy / "data" / "tiny").scenes
    before = scene.table.read_bytes()
    assert run("label", copy, "--label.appearance", "0.6") == 0
    table = scene.read_table()
    assert table["appearance"].between(0, 0.6).all() and table["appearance"].nunique() == len(table)
    assert read_json_object(scene.label_manifest)["appearance"] == 0.6
    assert run("label", copy) == 0 and scene.table.read_bytes() == before
    assert run("label", copy, "--label.appearance", "1.5") == 2


@pytest.mark.usefixtures("in_this_process", "no_pictures_here")
def test_views_of_changed_scenes_are_labelled_and_removed_again(copy, capsys):
    scene, *_ = Dataset.load(copy / "data" / "tiny").scenes
    before = scene.table.read_bytes()
    old = scene.read_table()
    mesh = fingerprint(scene.mesh)
    made = scene.folder / "changed.glb"
    changed = ("label", copy, "--label.changes", "0.8")
    assert run(*changed, scenes__apartment__clutter=0.3) == 2
    assert "generated with these options" in capsys.readouterr().err
    assert scene.table.read_bytes() == before and not made.exists()
    assert run(*changed) == 0
    table = scene.read_table()
    same = table["changes"] == 0
    assert set(table["changes"]) == {np.float32(0), np.float32(0.8)}
    pd.testing.assert_frame_equal(table[same].drop(columns="changes"), old[same])
    assert not table["n_inliers"][~same].equals(old["n_inliers"][~same])
    assert read_json_object(scene.label_manifest)["changed_mesh"] == fingerprint(made)
    assert fingerprint(scene.mesh) == mesh
    written = made.stat().st_mtime_ns
    assert run(*changed, "--label.store_matches", "true") == 0 and made.stat().st_mtime_ns == written
    assert run("label", copy) == 0 and scene.table.read_bytes() == before


@pytest.mark.usefixtures("in_this_process", "no_pictures_here")
def test_labels_by_another_localizer_replace_the_old_ones_when_they_are_finished(copy, monkeypatch):
    scenes = Dataset.load(copy / "data" / "tiny").scenes
    before = {scene: scene.table.read_bytes() for scene in scenes}
    plain = [scene.read_table() for scene in scenes]
    hypotheses = ("label", copy, "--label.localizer.method", "hypotheses")
    labelled = ShardWorker.label
    done = []

    def interrupted(worker, job, rows):
        if len(done) == 1:
            raise KeyboardInterrupt
        done.append(rows)
        return labelled(worker, job, rows)

    with monkeypatch.context() as patch:
        patch.setattr(ShardWorker, "label", interrupted)
        assert run(*hypotheses) != 0
    assert run("label", copy) == 0  # still current
    assert {scene: scene.table.read_bytes() for scene in scenes} == before
    assert run(*hypotheses) == 0
    for scene, by_one in zip(scenes, plain, strict=True):
        pd.testing.assert_frame_equal(with_first_labels(scene.read_table())[[*by_one]], by_one)
        assert not (scene.folder / "shards").exists()
    assert run("label", copy) == 0
    assert {scene: scene.table.read_bytes() for scene in scenes} == before


def test_three_lines_score_viewpoints_of_a_colmap_model(demo):
    scene = Dataset.load(demo / "data" / "tiny").scenes[1]
    table = scene.read_table()
    localization_map = LocalizationMap.from_colmap(scene.map, PinholeCamera(320, 240, 160), mesh=scene.mesh)
    weights = demo / "data" / "tiny" / "weights" / "mlp-2d+3d.safetensors"
    scores = load_scorer(localization_map, weights).score(poses(table))
    assert scores.shape == (len(table),) and np.all((scores > 0) & (scores < 1)) and np.ptp(scores) > 0
    # the mesh's rays and the occlusion stored by the sample stage agree
    binned = scene.localization_map(PinholeCamera(320, 240, 160)).bin_views(poses(table))
    np.testing.assert_array_equal(localization_map.bin_views(poses(table)).counts, binned.counts)


def test_every_occlusion_model_scores_the_same_viewpoints(copy):
    root = copy / "data" / "tiny"
    stored = pd.read_csv(root / "results" / "scores.csv")
    stored = stored[stored["method"] != "set that ships"].reset_index(drop=True)  # beside it in the demo alone
    assert set(stored["occlusion"]) == {"mesh"}
    assert run("evaluate", copy, "--evaluate.occlusions", "[mesh,tsdf,hidden-points,none]") == 0
    scores = pd.read_csv(root / "results" / "scores.csv")
    assert list(scores["occlusion"].unique()) == ["mesh", "tsdf", "hidden-points", "none"]
    # rays cast anew and those that the sample stage stored are the same
    pd.testing.assert_frame_equal(scores[scores["occlusion"] == "mesh"].reset_index(drop=True), stored)
    visible = scores[(scores["method"] == "visible") & (scores["scene"] == "all") & (scores["top_n"] == 1)]
    assert visible["average_precision"].nunique() > 1
    assert (root / "results" / "occlusion.png").stat().st_size > 10_000


@pytest.mark.parametrize("model", ["tsdf", "hidden-points", "none"])
def test_viewpoints_can_be_sampled_with_every_occlusion_model(copy, model):
    scene = Dataset.load(copy / "data" / "tiny").scenes[0]
    by_mesh = StoredOcclusion.load(scene.occlusion)
    assert by_mesh.name == "mesh"
    assert run("sample", copy, "--occlusion.model", model, occlusion__voxel_m=0.04) == 0
    stored = StoredOcclusion.load(scene.occlusion)
    assert stored.name == model
    if model == "none":
        assert stored.mask.all() and not by_mesh.mask.all()
    exact = LocalizationMap.from_colmap(scene.map, mesh=scene.mesh)
    truth = exact.occlusion.unoccluded(stored.locations, exact.landmarks.points)
    precision, recall = truth[stored.mask].mean(), stored.mask[truth].mean()
    assert precision > truth.mean() + {"tsdf": 0.3, "hidden-points": 0.03, "none": -1e-9}[model]
    assert recall > {"tsdf": 0.9, "hidden-points": 0.6, "none": 0.999}[model]


def test_a_stage_refuses_outdated_inputs(copy, capsys):
    mesh = Dataset.load(copy / "data" / "tiny").scenes[0].mesh
    before = mesh.stat().st_mtime_ns
    assert run("scenes", copy, "--camera.focal_px", "200") == 0
    assert mesh.stat().st_mtime_ns == before  # another camera does not change a mesh
    assert run("scenes", copy, scenes__apartment__texture_richness=0.3) == 0
    for stage, needed in (("label", "sample"), ("sample", "map"), ("evaluate", "label")):
        assert run(stage, copy) == 2
        assert f"Run `wheretolook {needed}`" in capsys.readouterr().err


def test_weights_are_not_tested_on_scenes_they_were_trained_on(copy):
    dataset = Dataset.load(copy / "data" / "tiny")
    replace(dataset, scenes=tuple(replace(scene, split="test") for scene in dataset.scenes)).save()
    weights = dataset.root / "weights" / "mlp-2d.safetensors"
    assert run("evaluate", copy) == 2
    assert run("evaluate", copy, "--evaluate.methods", "[mlp]", "--evaluate.weights", f"[{weights}]") == 2


PATHS = ["--grid", "[4, 4, 2]", "--directions", "40", "--max-turn-deg", "60", "--planner.time_s", "1",
         "--planner.spacing_m", "0.5"]  # fmt: skip


def test_planned_paths_are_rendered_and_localized(copy, capsys):
    options = ["compare-paths", copy, "--paths.pairs", "1", "--paths.methods", "[forward,set]", *PATHS]
    assert run(*options, paths__min_distance_m=1) == 0
    root = copy / "data" / "tiny" / "results"
    plain = pd.read_csv(root / "paths.csv")
    assert {*plain["method"]} == {"forward", "set", "set greedy"} and {*plain["pairs"]} == {1}
    views = pd.read_parquet(root / "paths" / "views.parquet")
    planned = views[(views["task"] == "planned") & (views["method"] == "set")]
    good = (planned["status"] == "localized") & (planned["error_m"] < 0.25) & (planned["error_deg"] < 2)
    share = plain[(plain["task"] == "planned") & (plain["method"] == "set")]["localized"]
    assert share.iloc[0] == pytest.approx(good.mean(), abs=1e-5)
    assert (root / "paths.png").stat().st_size > 5000
    capsys.readouterr()
    assert run(*options, paths__min_distance_m=1) == 0 and "reusing" in capsys.readouterr().out
    assert len(list(finished_runs(TrackingConfig(str(copy / "mlruns")), "paths"))) == 1  # nothing new to log

    joint = ["--paths.stops.looks", "3", "--paths.stops.least_score", "0.95", "--paths.last_views", "2"]
    assert run(*options, *joint, paths__min_distance_m=1) == 0
    table = pd.read_csv(root / "paths.csv")
    more = {"set with stops", "forward last 2 together", "set last 2 together"}
    assert {*table["method"]} == {*plain["method"], *more}
    single = table[~table["method"].isin(more)].reset_index(drop=True)
    pd.testing.assert_frame_equal(single[plain.columns], plain)  # the same paths, localized as before
    stopped = table[table["method"] == "set with stops"].set_index("task")
    assert (stopped["looks"] > 1).any()
    further = pd.read_parquet(next((root / "paths").glob("*/stops.parquet")))
    assert (stopped["looks"] * stopped["views"]).sum() == pytest.approx(stopped["views"].sum() + len(further), rel=1e-4)
    kept = {path: path.stat().st_mtime_ns for path in (root / "paths").glob("*/*.parquet")}
    assert run(*options, paths__min_distance_m=1) == 0  # reuses the views localized with more options
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    for invalid in (["--paths.methods", "[forward,visible]", *joint], ["--in-scenes", "[nowhere]"]):
        assert run(*options, *invalid, paths__min_distance_m=1) == 2


def test_a_camera_at_an_unknown_pose_turns_until_it_is_localized(copy):
    options = ["--places", "2", "--views", "3", "--policies", "[even,gain]"]
    assert run("relocalize", copy, *options, "--film", str(copy / "lost.webp")) == 0
    root = copy / "data" / "tiny" / "results"
    summary = pd.read_csv(root / "relocalize.csv")
    poses = pd.read_parquet(root / "relocalize" / "poses.parquet")
    chosen = poses[poses["hypothesis"] == 0]
    assert summary["policy"].tolist() == ["even", "gain"] and len(chosen) == 2 * 3 * summary["places"].iloc[0]
    first = chosen[chosen["n_looks"] == 1].set_index(["scene", "location_id"])
    pd.testing.assert_frame_equal(*(first[first["policy"] == name].drop(columns="policy") for name in ("even", "gain")))
    assert len(list(finished_runs(TrackingConfig(str(copy / "mlruns")), "relocalize"))) == 1
    kept = {path: path.stat().st_mtime_ns for path in (root / "relocalize").glob("*/poses.parquet")}
    assert run("relocalize", copy, *options, confidence=0.5) == 0
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert run("relocalize", copy, "--policies", "[forward]") == 2


def test_a_path_is_planned_and_shown(copy, tmp_path, monkeypatch):
    scene = Dataset.load(copy / "data" / "tiny").split("test")[0]
    centers = camera_centers(poses(scene.read_table()))
    out = tmp_path / "path"
    options = ["--scene", scene.name, "--plan.grid", "[4, 4, 2]", "--plan.directions", "40",
               "--plan.planner.time_s", "2", "--plan.planner.spacing_m", "0.5", "--out", str(out)]  # fmt: skip
    distance = np.linalg.norm(centers - centers[0], axis=1)
    goal = centers[np.where(distance > 0.5, distance, np.inf).argmin()]  # not far: there is little time
    ends = ["--start", str(centers[0].tolist()), "--goal", str(goal.tolist())]
    assert run("plan", copy, *options, *ends, "--plan.against", "[forward]") == 0
    table = pd.read_csv(out / "path.csv")
    np.testing.assert_allclose(table[["x_m", "y_m", "z_m"]].to_numpy()[[0, -1]], [centers[0], goal], atol=1e-6)
    assert table["score"].between(0, 1).all()
    assert {path.name for path in out.iterdir()} == {"path.csv", "path.png", "path.gif", "methods.png"}
    logged = newest_run(TrackingConfig(str(copy / "mlruns")), "plan")
    assert logged is not None and logged.data.metrics["score"] == pytest.approx(table["score"].mean(), abs=1e-4)
    monkeypatch.setitem(sys.modules, "rerun", None)
    wall = ["--start", "[-99, 0, 1]", "--goal", str(goal.tolist()), "--film", "none", "--method", "forward"]
    for invalid in ([*ends, "--plan.rerun", "true"], [], wall):
        assert run("plan", copy, *options, *invalid) == 2


def test_depth_images_bound_the_free_space(copy):
    """With the occlusion model tsdf; locations are sampled by the mesh all the same."""
    where = ["--config", str(copy / "tiny.yaml"), "--data", str(copy / "data"), "--device", "cpu"]
    experiment = with_fields(parse_command("plan", [*where, "--occlusion.model", "tsdf"]), {"occlusion.voxel_m": 0.04})
    environment = open_scene(experiment, Dataset.load(experiment.root).split("test")[0])
    by_mesh = environment.sampled_space
    assert type(by_mesh) is FreeSpace and isinstance(environment.space, TsdfSpace)
    points = np.random.default_rng(0).uniform(*by_mesh.bounds, (4000, 3))
    free = environment.space.is_free(points)
    expected = by_mesh.is_free(points)
    assert free.sum() > 100 and expected[free].mean() > 0.95 and free[expected].mean() < 1
    assert not free[by_mesh.raycaster.distance_to_surface(points, 1.0) < 0.25 - 2 * experiment.occlusion.voxel_m].any()
