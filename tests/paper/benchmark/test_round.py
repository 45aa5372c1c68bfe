"""The whole round on a small scene: select, render, localize, score; and which steps a second run repeats."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from paper.benchmark.conftest import IDS
from paper.benchmark.test_scores import loc_as_released, plan_as_released
from wheretolook.cli import main
from wheretolook.geometry.poses import camera_centers, pose_error
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh
from wheretolook.utils.errors import MapError, SceneError, TableError
from wheretolook_paper.benchmark.files import DRAWN_CAMERA, BenchmarkScene, read_errors, read_poses
from wheretolook_paper.benchmark.round import RoundConfig, SceneRound

pytestmark = pytest.mark.slow

METHODS = ("best", "max-visibility", "max-visibility-shipped")


def benchmark(scene, out, *options):
    shared = ["--workers", "1", "--device", "cpu", "--directions", "60"]
    return main(["benchmark", str(scene), "--out", str(out), *shared, *options])


@pytest.fixture(scope="module")
def out(scene_folder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("out")
    assert benchmark(scene_folder, folder) == 0
    return folder


@pytest.fixture
def copied(out, tmp_path):
    return Path(shutil.copytree(out, tmp_path / "out"))


def times(folder):
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("method", METHODS)
def test_files_and_summary_of_a_method(method, out, scene_folder):
    folder = out / scene_folder.name / method
    poses = read_poses(folder / "selected_gt_poses.txt")
    errors = read_errors(folder / "pose_errors.txt")
    assert poses.ids == IDS and errors.ids == tuple(sorted(IDS))
    places = np.loadtxt(scene_folder / "waypoints.txt")
    assert_allclose(camera_centers(poses.cam_from_world), places[:, 1:], atol=1e-9)
    drawn = WarpRenderer(load_mesh(scene_folder / "room.glb")).render(DRAWN_CAMERA, poses.cam_from_world[[4]]).rgb[0]
    np.testing.assert_array_equal(cv2.imread(str(folder / "images" / "5.png"))[:, :, ::-1], drawn)
    estimates = read_poses(folder / "estimate_poses.txt")
    truth = poses.cam_from_world[[poses.ids.index(name) for name in estimates.ids]]
    rows = [errors.ids.index(name) for name in estimates.ids]
    assert_allclose([errors.metres[rows], errors.degrees[rows]], pose_error(estimates.cam_from_world, truth), atol=1e-6)
    summary = pd.read_csv(out / "summary.csv").query("method == @method")
    shipped = [*zip(summary["as_shipped_hits"], summary["as_shipped_total"], strict=True)]
    paths = folder / "pose_errors.txt", folder / "selected_gt_poses.txt"
    assert shipped == [*loc_as_released(paths[0]), plan_as_released(*paths)]
    views = pd.read_csv(out / "views.csv", dtype={"id": str}).query("method == @method")
    assert [*summary["mended_hits"]] == [views[measure].sum() for measure in summary["measure"]]


def test_best_views_localize_more_often_than_the_released_baseline(out):
    summary = pd.read_csv(out / "summary.csv").set_index(["method", "measure"])["mended_hits"]
    assert summary["best", "0.05m_0.4deg"] >= 10
    assert summary["max-visibility-shipped", "0.25m_2deg"] < summary["max-visibility", "0.25m_2deg"]


def test_a_second_run_does_only_what_is_missing(copied, scene_folder):
    before = times(copied)
    assert benchmark(scene_folder, copied) == 0
    reports = {"summary.csv", "summary.md", "views.csv"}
    assert {name for name, time in times(copied).items() if before.get(name) != time} <= reports
    folder = copied / scene_folder.name / "best"
    errors = folder / "pose_errors.txt"
    whole = errors.read_text()
    errors.write_text("".join(line for line in whole.splitlines(True) if line.split()[0] not in ("3", "11")))
    (folder / "images" / "7.png").unlink()
    before = times(copied)
    assert benchmark(scene_folder, copied, "--methods", "best") == 0
    assert errors.read_text() == whole
    changed = {name.rpartition("best/")[2] for name, time in times(copied).items() if before.get(name) != time}
    redone = {"pose_errors.txt", "estimate_poses.txt", "images/7.png"}
    assert redone <= changed <= redone | reports | {"made-from.json"}


def test_other_options_replace_the_selection(copied, scene_folder, tmp_path):
    few = tmp_path / "few.txt"
    few.write_text("# id x y z\nb 2.5 2.0 1.3\na 2.6 2.0 1.3\n")
    assert benchmark(scene_folder, copied, "--methods", "max-visibility-shipped", "--waypoints", str(few)) == 0
    folder = copied / scene_folder.name / "max-visibility-shipped"
    assert {path.name for path in (folder / "images").iterdir()} == {"a.png", "b.png"}
    assert read_errors(folder / "pose_errors.txt").ids == ("a", "b")
    assert benchmark(scene_folder, copied, "--methods", "best", "--max-turn", "12") == 0
    views = pd.read_csv(copied / "views.csv")
    assert {*views["method"]} == {"best-turn12"} and views["turn_deg"].max() <= 12 + 1e-5


def test_the_benchmarks_own_script_can_localize(scene_folder, tmp_path, capsys):
    options = ("--methods", "visible", "--localizer", "none")
    assert benchmark(scene_folder, tmp_path, *options) == 0
    errors = tmp_path / scene_folder.name / "visible" / "pose_errors.txt"
    assert str(errors) in capsys.readouterr().out and not (tmp_path / "summary.csv").exists()
    errors.write_text("".join(f"{name}.png nan nan \n" for name in sorted(IDS)))
    assert benchmark(scene_folder, tmp_path, *options) == 0
    assert pd.read_csv(tmp_path / "summary.csv")["mended_hits"].sum() == 0
    assert benchmark(scene_folder, tmp_path, *options[:2]) == 0  # does not overwrite them
    assert np.isnan(read_errors(errors).metres).all()
    scored = ("--errors", str(errors), "--poses", str(errors.with_name("selected_gt_poses.txt")))
    assert main(["benchmark", *scored, "--out", str(tmp_path / "scored")]) == 0


@pytest.mark.parametrize(
    ("missing", "error"),
    [
        ("scene_reconstruction/points3D.bin", MapError),
        ("waypoints.txt", TableError),
        ("room.glb", SceneError),
        ("scene_reconstruction/images/00003.png", MapError),
    ],
)
def test_missing_files(missing, error, scene_folder, tmp_path):
    scene = Path(shutil.copytree(scene_folder, tmp_path / scene_folder.name))
    (scene / missing).unlink()
    with pytest.raises(error):
        SceneRound(BenchmarkScene.of(scene), tmp_path / "out", RoundConfig(directions=60)).run("max-visibility-shipped")


@pytest.mark.parametrize("arguments", [(), ("--errors", "e.txt"), ("a", "--lattice", "x"), ("a", "a"), ("nowhere",)])
def test_invalid_options(arguments):
    assert main(["benchmark", *arguments]) == 2
