"""The whole line on two tiny apartments: from the command line, again, from the same seed, and after damage."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
import pytest
from scipy.spatial import cKDTree

from mask_agreement import MaskAgreement
from wheretolook.cli import main, parse_command
from wheretolook.commands.preconditions import open_scene
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_table import is_good, poses, read_table, write_table
from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import camera_centers
from wheretolook.inputs.channels import CHANNELS
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scorers.mlp.network import ViewpointNetwork
from wheretolook.scorers.registry import scorers
from wheretolook.scorers.train_config import TrainConfig
from wheretolook.space.free_space import FreeSpace
from wheretolook.space.tsdf_space import TsdfSpace
from wheretolook.tracking.config import TrackingConfig
from wheretolook.tracking.runs import artifact, finished_runs, newest_run
from wheretolook.tracking.store import client
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.errors import TableError
from wheretolook.utils.files import fingerprint
from wheretolook.visibility.hidden_points import HiddenPointRemoval
from wheretolook.visibility.occlusion import StoredOcclusion
from wheretolook.weights.resolve import load_scorer
from wheretolook_paper.paths.path_comparison import draw_pairs

pytestmark = pytest.mark.slow  # the whole line, several times over

EXPERIMENT = """\
name: tiny
camera: {width: 320, height: 240, focal_px: 160}
scenes:
  train: 1
  test: 1
  apartment: {n_rooms: 3, area_m2: 26, texture_size: 1024, texels_per_m: 40, light_spacing_m: 0.5, light_rays: 4}
map: {n_images: 24}
sample: {grid: [6, 6, 4], directions: 100, keep: 50, max_locations: 8, max_directions: 5}
label: {workers: 1, shard_size: 20}
train: {val_fraction: 0.3, methods: [mlp-2d, mlp-2d+3d, set], mlp: {epochs: 2}, set: {epochs: 2, batch_size: 1}}
evaluate: {resamples: 20, top_n: [1], methods: [random, visible, bins, fisher-trace-exact, mlp, set]}
"""


def run(stage: str, folder: Path, *options: str) -> int:
    return main(
        [stage, "--config", str(folder / "tiny.yaml"), "--data", str(folder / "data"),
         "--tracking.folder", str(folder / "mlruns"), "--device", "cpu", *options]
    )  # fmt: skip


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo")
    (folder / "tiny.yaml").write_text(EXPERIMENT)
    assert run("demo", folder) == 0
    return folder


@pytest.fixture
def copy(demo: Path, tmp_path: Path) -> Path:
    """A copy that may be damaged."""
    shutil.copytree(demo, tmp_path / "copy")
    return tmp_path / "copy"


def results(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("data/tiny/*/**/*") if path.is_file() and path.name != "stages.json")


def test_every_stage_leaves_its_result(demo: Path) -> None:
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
    for picture in ("scores.png", "overview.png"):
        assert (dataset.root / "results" / picture).stat().st_size > 10_000
    run_of_evaluation = newest_run(TrackingConfig(str(demo / "mlruns")), "evaluate")
    assert run_of_evaluation is not None and run_of_evaluation.info.status == "FINISHED"


def test_run_again_it_reuses_what_is_there(demo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in results(demo)}
    runs = all_runs(demo)
    assert run("demo", demo) == 0
    assert {path: path.stat().st_mtime_ns for path in results(demo)} == before
    assert all_runs(demo) == runs
    said = capsys.readouterr().out
    assert "[evaluate] reusing" in said and said.startswith(f"Data go to {demo / 'data' / 'tiny'}, runs to ")


def all_runs(folder: Path) -> set[str]:
    """Ids of all runs in the store."""
    mlflow = client(TrackingConfig(str(folder / "mlruns")))
    experiments = [one.experiment_id for one in mlflow.search_experiments()]
    return {one.info.run_id for one in mlflow.search_runs(experiments, max_results=1000)}


def test_the_demo_ends_in_a_sentence_a_picture_and_what_to_do_next(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("demo", copy) == 0
    end = capsys.readouterr().out.partition("\nDone in ")[2]
    root = copy / "data" / "tiny"
    scores = pd.read_csv(root / "results" / "scores.csv")
    pooled = scores[scores["scene"] == "all"].set_index("method")
    sentence, _, places = end.partition("\n\n")[2].partition("\n\n")
    best = pooled.drop(index=["oracle", "random"])["good_0.05m_0.4deg"].max()
    text = " ".join(sentence.split())
    assert f"at {best:.0f} of {pooled['n_locations'].iloc[0]} locations; " in text
    assert f"and the oracle, which knows, at {pooled.loc['oracle', 'good_0.05m_0.4deg']:.0f}." in text
    assert "95 % interval" in text or "too few" in text
    shown = dict(line.split(maxsplit=1) for line in places.replace("your own map", "next").splitlines() if line)
    for name in ("picture", "tables"):
        assert Path(shown[name]).is_file()
    assert shown["next"].startswith("wheretolook select --map ") and "mlflow ui" in shown["runs"]


def test_all_methods_are_trained_and_compared(copy: Path) -> None:
    methods = EvaluateConfig().methods
    learned = TrainConfig().methods
    assert run("train", copy, "--train.methods", f"[{','.join(learned)}]") == 0
    assert run("evaluate", copy, "--evaluate.methods", f"[{','.join(methods)}]") == 0
    scores = pd.read_csv(copy / "data" / "tiny" / "results" / "scores.csv")
    rules = {name for name in methods if not scorers()[name].weights}
    assert {*learned, *rules} <= {*scores["method"]}


@pytest.mark.parametrize("workers", ["1", "2"])
def test_the_same_seed_gives_the_same_bytes(
    demo: Path, tmp_path: Path, workers: str, request: pytest.FixtureRequest
) -> None:
    if workers == "1":
        request.getfixturevalue("in_this_process")
    (tmp_path / "tiny.yaml").write_text(EXPERIMENT)
    for stage in ("scenes", "map", "sample", "label"):
        assert run(stage, tmp_path, "--scenes.test", "0", "--label.workers", workers, "--label.shard_size", "7") == 0
    for name in ("mesh.glb", "map/points3D.bin", "map/landmarks.npz", "occlusion.npz", "viewpoints.parquet"):
        ours, theirs = (folder / "data" / "tiny" / "apartment-000" / name for folder in (tmp_path, demo))
        assert fingerprint(ours) == fingerprint(theirs), name


@pytest.mark.usefixtures("in_this_process", "no_pictures_here")
def test_a_changed_setting_remakes_what_depends_on_it(copy: Path) -> None:
    scene = Dataset.load(copy / "data" / "tiny").scenes[0]
    mesh = fingerprint(scene.mesh)
    table = scene.read_table()
    assert run("sample", copy, "--sample.seed", "5") == 0
    assert fingerprint(scene.mesh) == mesh
    assert (scene.read_table()["status"] == "unlabelled").all()
    assert run("sample", copy) == 0 and run("label", copy) == 0
    pd.testing.assert_frame_equal(scene.read_table(), table)


@pytest.mark.usefixtures("in_this_process", "no_pictures_here")
def test_matches_are_stored_when_asked_for_and_go_with_the_labels_they_belong_to(copy: Path) -> None:
    scenes = Dataset.load(copy / "data" / "tiny").scenes
    before = {scene: scene.table.read_bytes() for scene in scenes}
    stored = ("label", copy, "--label.store_matches", "true")
    assert run(*stored) == 0  # the finished labels do not have them
    for scene in scenes:
        table = read_table(scene.table, matches=True)
        assert (table["inlier_rows"].map(len) == table["n_inliers"]).all()
        assert all(np.isin(*rows).all() for rows in table[["inlier_rows", "matched_rows"]].itertuples(index=False))
        assert np.concatenate(table["matched_rows"].to_list()).max() < len(np.load(scene.landmarks)["ids"])
        write_table(scene.read_table(), copy / "labels.parquet")
        assert (copy / "labels.parquet").read_bytes() == before[scene]
    after = {scene: scene.table.stat().st_mtime_ns for scene in scenes}
    assert run(*stored) == 0
    assert {scene: scene.table.stat().st_mtime_ns for scene in scenes} == after

    assert run("label", copy) == 0
    assert {scene: scene.table.read_bytes() for scene in scenes} == before
    assert run(*stored) == 0 and run("sample", copy, "--sample.seed", "5") == 0
    for scene in scenes:
        with pytest.raises(TableError, match="store_matches"):
            read_table(scene.table, matches=True)


def test_three_lines_score_viewpoints_of_a_colmap_model(demo: Path) -> None:
    scene = Dataset.load(demo / "data" / "tiny").scenes[1]
    table = scene.read_table()
    localization_map = LocalizationMap.from_colmap(scene.map, PinholeCamera(320, 240, 160), mesh=scene.mesh)
    weights = demo / "data" / "tiny" / "weights" / "mlp-2d+3d.safetensors"
    scores = load_scorer(weights, localization_map).score(poses(table))
    assert scores.shape == (len(table),) and np.all((scores > 0) & (scores < 1)) and np.ptp(scores) > 0
    assert TrainedNetwork.load(weights, ViewpointNetwork, "mlp-2d+3d").network.spec.channels == CHANNELS
    # the camera that mapped is the same pinhole, projected by COLMAP; landmarks on an edge may be rounded otherwise
    by_colmap = LocalizationMap.from_colmap(scene.map, PinholeCamera(320, 240, 160.0).colmap, mesh=scene.mesh)
    difference = by_colmap.bin_views(poses(table)).counts - localization_map.bin_views(poses(table)).counts
    assert np.abs(difference).sum() <= 2
    hidden = LocalizationMap.from_colmap(scene.map, PinholeCamera(320, 240, 160), occlusion=HiddenPointRemoval())
    assert hidden.bin_views(poses(table)).counts.sum() > 0
    # the mesh's rays and the occlusion stored by the sample stage agree
    binned = scene.localization_map(PinholeCamera(320, 240, 160)).bin_views(poses(table))
    np.testing.assert_array_equal(localization_map.bin_views(poses(table)).counts, binned.counts)


def test_every_occlusion_model_scores_the_same_viewpoints(copy: Path) -> None:
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
    assert "By occlusion model" in (root / "results" / "scores.md").read_text()
    tracking = TrackingConfig(str(copy / "mlruns"))
    parent = newest_run(tracking, "evaluate")
    assert parent is not None
    runs = client(tracking).search_runs(
        [parent.info.experiment_id], f"tags.mlflow.parentRunId = '{parent.info.run_id}'"
    )
    assert {one.data.params["occlusion"] for one in runs} == set(scores["occlusion"])


@pytest.mark.parametrize("model", ["tsdf", "hidden-points", "none"])
def test_viewpoints_can_be_sampled_with_every_occlusion_model(copy: Path, model: str) -> None:
    scene = Dataset.load(copy / "data" / "tiny").scenes[0]
    by_mesh = StoredOcclusion.load(scene.occlusion)
    assert by_mesh.name == "mesh"
    assert run("sample", copy, "--occlusion.model", model, "--occlusion.voxel_m", "0.04") == 0
    stored = StoredOcclusion.load(scene.occlusion)
    assert stored.name == model
    if model == "none":
        assert stored.mask.all() and not by_mesh.mask.all()
    exact = LocalizationMap.from_colmap(scene.map, mesh=scene.mesh)
    truth = exact.occlusion.unoccluded(stored.locations, exact.landmarks.points)
    agreement = MaskAgreement.between(stored.mask, truth)
    assert agreement.precision > truth.mean() + {"tsdf": 0.3, "hidden-points": 0.03, "none": -1e-9}[model]
    assert agreement.recall > {"tsdf": 0.9, "hidden-points": 0.6, "none": 0.999}[model]


def test_a_stage_refuses_what_an_earlier_one_has_remade(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("scenes", copy, "--scenes.apartment.texture_richness", "0.3") == 0
    for stage, needed in (("label", "sample"), ("sample", "map"), ("evaluate", "label")):
        assert run(stage, copy) == 2
        assert f"Run `wheretolook {needed}`" in capsys.readouterr().err


def test_another_camera_makes_all_but_the_meshes_anew(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh = Dataset.load(copy / "data" / "tiny").scenes[0].mesh
    before = mesh.stat().st_mtime_ns
    assert run("scenes", copy, "--camera.focal_px", "200") == 0
    assert mesh.stat().st_mtime_ns == before
    assert run("label", copy, "--camera.focal_px", "200") == 2
    assert "Run `wheretolook sample`" in capsys.readouterr().err


def test_weights_are_not_tested_on_what_they_learnt_from(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = copy / "data" / "tiny"
    dataset = Dataset.load(root)
    replace(dataset, scenes=tuple(replace(scene, split="test") for scene in dataset.scenes)).save()
    weights = root / "weights" / "mlp-2d.safetensors"
    assert run("evaluate", copy, "--evaluate.methods", "[mlp]", "--evaluate.weights", f"[{weights}]") == 2
    assert "learnt from a scene of the test split (got 'apartment-000')" in capsys.readouterr().err
    assert run("evaluate", copy) == 2
    assert "trained on other data" in capsys.readouterr().err


PATHS = ["--paths.grid", "[4, 4, 2]", "--paths.directions", "40", "--paths.min_distance_m", "1", "--paths.max_turn_deg",
         "60", "--paths.planner.time_s", "1", "--paths.planner.spacing_m", "0.5"]  # fmt: skip


def test_planned_paths_are_rendered_and_localized(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--paths.pairs", "2", "--paths.methods", "[forward,visible]", *PATHS]
    assert run("compare-paths", copy, *options) == 0
    root = copy / "data" / "tiny" / "results"
    table = pd.read_csv(root / "paths.csv")
    assert {*table["method"]} == {"forward", "visible", "visible greedy"} and {*table["pairs"]} == {2}
    views = pd.read_parquet(root / "paths" / "views.parquet")
    assert views["status"].isin(["localized", "no_pose", "too_few_matches"]).all()
    planned = views[(views["task"] == "planned") & (views["method"] == "visible")]
    good = (planned["status"] == "localized") & (planned["error_m"] < 0.25) & (planned["error_deg"] < 2)
    said = table[(table["task"] == "planned") & (table["method"] == "visible")]["localized"]
    assert said.iloc[0] == pytest.approx(good.mean(), abs=1e-5)
    assert (root / "paths.png").stat().st_size > 5000 and "| visible" in capsys.readouterr().out
    assert newest_run(TrackingConfig(str(copy / "mlruns")), "paths") is not None
    before = (root / "paths" / "views.parquet").read_bytes()
    assert run("compare-paths", copy, *options) == 0
    assert "reusing" in capsys.readouterr().out and (root / "paths" / "views.parquet").read_bytes() == before
    assert len(list(finished_runs(TrackingConfig(str(copy / "mlruns")), "paths"))) == 1  # nothing new to log
    kept = next((root / "paths").glob("*/views.parquet"))
    content = kept.read_bytes()
    kept.write_bytes(content[: len(content) // 2])
    assert run("compare-paths", copy, *options) == 0
    assert len(pd.read_parquet(kept))
    assert run("compare-paths", copy, "--paths.scenes", "[nowhere]") == 2
    assert "There are" in capsys.readouterr().err


def test_views_along_paths_are_localized_together(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--paths.pairs", "1", "--paths.methods", "[forward,set]", *PATHS]
    assert run("compare-paths", copy, *options) == 0
    root = copy / "data" / "tiny" / "results"
    plain = pd.read_csv(root / "paths.csv")
    assert "looks" not in plain
    joint = ["--paths.stops.looks", "3", "--paths.stops.least_score", "0.95", "--paths.last_views", "2"]
    assert run("compare-paths", copy, *options, *joint) == 0
    assert "| set with stops" in capsys.readouterr().out
    table = pd.read_csv(root / "paths.csv")
    more = {"set with stops", "forward last 2 together", "set last 2 together"}
    assert {*table["method"]} == {*plain["method"], *more}
    single = table[~table["method"].isin(more)].reset_index(drop=True)
    pd.testing.assert_frame_equal(single[plain.columns], plain)  # the same paths, localized as before
    stopped = table[table["method"] == "set with stops"].set_index("task")
    alone = table[table["method"] == "set"].set_index("task")
    assert (stopped["looks"] > 1).any() and (alone["looks"] == 1).all()
    assert (stopped["turn_deg_per_m"] > alone["turn_deg_per_m"]).any()
    scene = next((root / "paths").glob("*/stops.parquet")).parent
    further = pd.read_parquet(scene / "stops.parquet")
    assert further["look"].between(2, 3).all() and (stopped["looks"] * stopped["views"]).sum() == pytest.approx(
        stopped["views"].sum() + len(further), rel=1e-4
    )
    kept = {path: path.stat().st_mtime_ns for path in [*scene.glob("*shards/*.parquet"), *scene.glob("*.parquet")]}
    assert run("compare-paths", copy, *options, *joint) == 0
    assert run("compare-paths", copy, *options) == 0  # what was localized with more than is needed
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    pd.testing.assert_frame_equal(pd.read_csv(root / "paths.csv"), plain)
    assert run("compare-paths", copy, *options, "--paths.methods", "[forward,visible]", *joint) == 2
    assert "probabilities" in capsys.readouterr().err


def test_a_path_is_planned_and_shown(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Dataset.load(copy / "data" / "tiny").split("test")[0]
    centers = camera_centers(poses(scene.read_table()))
    options = ["--scene", scene.name, "--plan.grid", "[4, 4, 2]", "--plan.directions", "40",
               "--plan.planner.time_s", "2", "--plan.planner.spacing_m", "0.5"]  # fmt: skip
    options += ["--out", str(tmp_path / "way")]
    away = np.linalg.norm(centers - centers[0], axis=1)
    goal = centers[np.where(away > 0.5, away, np.inf).argmin()]  # not far: there is little time
    ends = ["--start", str(centers[0].tolist()), "--goal", str(goal.tolist())]
    assert run("plan", copy, *options, *ends, "--plan.against", "[forward]") == 0
    assert "mean score" in capsys.readouterr().out
    table = pd.read_csv(tmp_path / "way" / "path.csv")
    np.testing.assert_allclose(table[["x_m", "y_m", "z_m"]].to_numpy()[[0, -1]], [centers[0], goal], atol=1e-6)
    axes = table[["axis_x", "axis_y", "axis_z"]].to_numpy()
    np.testing.assert_allclose(poses(table)[:, 2, :3], axes, atol=1e-6)
    assert table["score"].between(0, 1).all()
    assert {path.name for path in (tmp_path / "way").iterdir()} == {
        "path.csv", "path.png", "path.gif", "methods.png",
    }  # fmt: skip
    logged = newest_run(TrackingConfig(str(copy / "mlruns")), "plan")
    assert logged is not None and logged.data.metrics["score"] == pytest.approx(table["score"].mean(), abs=1e-4)
    assert artifact(TrackingConfig(str(copy / "mlruns")), logged.info.run_id, "methods.png").is_file()
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert run("plan", copy, *options, *ends, "--plan.rerun", "true") == 2
    assert run("plan", copy, *options) == 2
    assert "needs a start and a goal" in capsys.readouterr().err
    wall = ["--start", "[-99, 0, 1]", "--goal", str(goal.tolist()), "--film", "none", "--method", "forward"]
    assert run("plan", copy, *options, *wall) == 2
    assert "the start is not in free space" in capsys.readouterr().err


def _longest_straight_way(pairs: np.ndarray, space: TsdfSpace) -> int:
    """Which of pairs (P, 2, 3) m are farthest apart with nothing but free space straight between them and around.

    Elsewhere a path may cross what is clear, yet not free, such as where depth images saw no floor below.
    """
    along = pairs[:, None, :1] + np.linspace(0, 1, 30)[1:-1, None, None] * (pairs[:, None, 1:] - pairs[:, None, :1])
    around = along + 0.05 * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    straight = space.is_free(around.reshape(-1, 3)).reshape(len(pairs), -1).all(1)
    assert straight.any()
    return int(np.where(straight, np.linalg.norm(pairs[:, 1] - pairs[:, 0], axis=1), 0).argmax())


def test_paths_keep_clear_of_what_depth_images_saw(copy: Path, tmp_path: Path) -> None:
    """With the occlusion model tsdf; locations are sampled by the mesh all the same."""
    tsdf = ["--occlusion.model", "tsdf", "--occlusion.voxel_m", "0.04"]
    options = ["--config", str(copy / "tiny.yaml"), "--data", str(copy / "data"), "--device", "cpu", *tsdf]
    experiment = parse_command("plan", options)
    assert experiment is not None
    dataset = Dataset.load(experiment.root)
    scene = dataset.split("test")[0]
    opened = open_scene(experiment, scene)
    by_mesh = opened.sampled_space
    space = opened.space
    assert type(by_mesh) is FreeSpace and isinstance(space, TsdfSpace) and opened.occlusion.name == "tsdf"
    points = np.random.default_rng(0).uniform(*by_mesh.bounds, (4000, 3))
    free = space.is_free(points)
    expected = by_mesh.is_free(points)
    assert free.sum() > 100 and expected[free].mean() > 0.95 and free[expected].mean() < 1
    assert not free[by_mesh.raycaster.distance_to_surface(points, 1.0) < 0.25 - 2 * experiment.occlusion.voxel_m].any()
    pairs = draw_pairs(space, replace(experiment.paths, pairs=20, min_distance_m=0.5))
    way = pairs[_longest_straight_way(pairs, space)]
    ends = ["--start", str(way[0].tolist()), "--goal", str(way[1].tolist()), "--out", str(tmp_path / "way")]
    rest = ["--scene", scene.name, "--method", "forward", "--film", "none", "--plan.planner.time_s", "1"]
    assert run("plan", copy, *tsdf, *ends, *rest) == 0
    path = pd.read_csv(tmp_path / "way" / "path.csv")[["x_m", "y_m", "z_m"]].to_numpy()
    assert len(path) > 1 and space.is_free(path).all()
    assert (by_mesh.raycaster.distance_to_surface(path, 1.0) > 0.25 - 2 * experiment.occlusion.voxel_m).all()
    unseen = space.cells.centers()[space.to_unseen_m.ravel() == 0]
    assert cKDTree(unseen).query(path)[0].min() > space.config.clearance_m
