"""The whole round on a small scene: select, draw, localize, score; and what of it is done again."""

from __future__ import annotations

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
from wheretolook.utils.errors import ConfigError, MapError, SceneError, TableError, WhereToLookError
from wheretolook_paper.benchmark.files import read_errors, read_poses
from wheretolook_paper.benchmark.folder import DRAWN_CAMERA
from wheretolook_paper.benchmark.scores import PLAN

METHODS = ("best", "max-visibility", "max-visibility-shipped")


def benchmark(scene: Path, out: Path, *options: str) -> int:
    return main(
        [
            "benchmark",
            str(scene),
            "--out",
            str(out),
            "--workers",
            "1",
            "--device",
            "cpu",
            "--directions",
            "60",
            *options,
        ]
    )


@pytest.fixture(scope="module")
def out(scene_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("out")
    assert benchmark(scene_folder, folder) == 0
    return folder


@pytest.fixture
def copied(out: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(out, tmp_path / "out"))


def changed(before: dict[Path, int], folder: Path) -> set[str]:
    after = times(folder)
    return {str(path) for path in {*before, *after} if before.get(path) != after.get(path)}


def times(folder: Path) -> dict[Path, int]:
    return {path.relative_to(folder): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("method", METHODS)
def test_the_round_leaves_the_benchmarks_files(method: str, out: Path, scene_folder: Path) -> None:
    folder = out / scene_folder.name / method
    poses = read_poses(folder / "selected_gt_poses.txt")
    errors = read_errors(folder / "pose_errors.txt")
    assert poses.ids == IDS and errors.ids == tuple(sorted(IDS))
    places = np.loadtxt(scene_folder / "waypoints.txt")
    assert_allclose(camera_centers(poses.cam_from_world), places[:, 1:], atol=1e-9)
    drawn = WarpRenderer(load_mesh(scene_folder / "room.glb")).render(DRAWN_CAMERA, poses.cam_from_world[[4]]).rgb[0]
    np.testing.assert_array_equal(cv2.imread(str(folder / "images" / "5.png"))[:, :, ::-1], drawn)
    estimates = read_poses(folder / "estimate_poses.txt")
    assert {*estimates.ids} == {name for name, m in zip(errors.ids, errors.metres, strict=True) if np.isfinite(m)}
    rows = [poses.ids.index(name) for name in estimates.ids]
    metres, degrees = pose_error(estimates.cam_from_world, poses.cam_from_world[rows])
    rows = [errors.ids.index(name) for name in estimates.ids]
    assert_allclose(errors.metres[rows], metres, atol=1e-9)
    assert_allclose(errors.degrees[rows], degrees, atol=1e-6)


def test_best_views_localize_and_those_of_the_baseline_as_shipped_less_often(out: Path) -> None:
    summary = pd.read_csv(out / "summary.csv").set_index(["method", "measure"])["mended_hits"]
    assert summary["best", "0.05m_0.4deg"] >= 10
    assert summary["max-visibility-shipped", "0.25m_2deg"] < summary["max-visibility", "0.25m_2deg"]


@pytest.mark.parametrize("method", METHODS)
def test_the_summary_is_what_the_scripts_compute_on_these_files(method: str, out: Path, scene_folder: Path) -> None:
    folder = out / scene_folder.name / method
    errors = folder / "pose_errors.txt"
    poses = folder / "selected_gt_poses.txt"
    summary = pd.read_csv(out / "summary.csv")
    summary = summary[summary["method"] == method]
    shipped = [*zip(summary["as_shipped_hits"], summary["as_shipped_total"], strict=True)]
    assert shipped == [*loc_as_released(errors), plan_as_released(errors, poses)]
    views = pd.read_csv(out / "views.csv", dtype={"id": str})
    views = views[views["method"] == method]
    assert [*summary["mended_hits"]] == [views[measure].sum() for measure in summary["measure"]]
    good = (views["error_m"] <= 0.25) & (views["error_deg"] <= 2) & (views["turn_deg"] <= 30)
    assert (views[PLAN] == good).all()


def test_done_again_only_the_tables_are_written(copied: Path, scene_folder: Path) -> None:
    before = times(copied)
    summary = (copied / "summary.csv").read_text()
    assert benchmark(scene_folder, copied) == 0
    assert changed(before, copied) <= {"summary.csv", "summary.md", "views.csv"}
    assert (copied / "summary.csv").read_text() == summary


def test_an_interrupted_round_goes_on(copied: Path, scene_folder: Path) -> None:
    folder = copied / scene_folder.name / "best"
    errors = folder / "pose_errors.txt"
    whole = (folder / "pose_errors.txt").read_text()
    errors.write_text("".join(line for line in whole.splitlines(True) if line.split()[0] not in ("3", "11")))
    (folder / "images" / "7.png").unlink()
    before = times(copied)
    summary = (copied / "summary.csv").read_text()
    assert benchmark(scene_folder, copied, "--methods", "best") == 0
    assert errors.read_text() == whole
    name = f"{scene_folder.name}/best"
    redone = {f"{name}/{file}" for file in ("pose_errors.txt", "estimate_poses.txt", "images/7.png")}
    assert (
        redone
        <= changed(before, copied)
        <= redone | {f"{name}/made-from.json", *("summary.csv", "summary.md", "views.csv")}
    )
    assert (copied / "summary.csv").read_text() == "".join(summary.splitlines(True)[:6])


def test_other_waypoints_begin_anew(copied: Path, scene_folder: Path, tmp_path: Path) -> None:
    few = tmp_path / "few.txt"
    few.write_text("# id x y z\nb 2.5 2.0 1.3\na 2.6 2.0 1.3\n")
    assert benchmark(scene_folder, copied, "--methods", "max-visibility-shipped", "--waypoints", str(few)) == 0
    folder = copied / scene_folder.name / "max-visibility-shipped"
    assert {path.name for path in (folder / "images").iterdir()} == {"a.png", "b.png"}
    assert read_poses(folder / "selected_gt_poses.txt").ids == ("b", "a")
    assert read_errors(folder / "pose_errors.txt").ids == ("a", "b")


def test_the_benchmarks_own_script_can_localize(
    scene_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = "--methods", "visible", "--localizer", "none"
    assert benchmark(scene_folder, tmp_path, *options) == 0
    folder = tmp_path / scene_folder.name / "visible"
    assert f"{folder / 'pose_errors.txt'} is missing" in capsys.readouterr().out
    assert len([*(folder / "images").iterdir()]) == len(IDS) and not (tmp_path / "summary.csv").exists()
    (folder / "pose_errors.txt").write_text("".join(f"{name}.png nan nan \n" for name in sorted(IDS)))
    assert benchmark(scene_folder, tmp_path, *options) == 0
    assert pd.read_csv(tmp_path / "summary.csv")["mended_hits"].sum() == 0
    # its errors are not written over by ours
    assert benchmark(scene_folder, tmp_path, *options[:2]) == 0
    assert "another localizer are kept" in capsys.readouterr().out
    assert np.isnan(read_errors(folder / "pose_errors.txt").metres).all()


def test_a_limit_on_turns(copied: Path, scene_folder: Path) -> None:
    assert benchmark(scene_folder, copied, "--methods", "best", "--max-turn", "12") == 0
    views = pd.read_csv(copied / "views.csv")
    assert {*views["method"]} == {"best-turn12"} and views["turn_deg"].max() <= 12 + 1e-5


def remade(scene_folder: Path, folder: Path) -> Path:
    return Path(shutil.copytree(scene_folder, folder / scene_folder.name))


@pytest.mark.parametrize(
    ("missing", "error", "named"),
    [
        ("scene_reconstruction", MapError, "scene_reconstruction"),
        ("scene_reconstruction/points3D.bin", MapError, "scene_reconstruction"),
        ("waypoints.txt", TableError, "waypoints.txt"),
        ("room.glb", SceneError, "room.glb"),
        ("scene_reconstruction/images", MapError, "scene_reconstruction/images"),
        ("scene_reconstruction/images/00003.png", MapError, "00003.png"),
    ],
)
def test_what_is_missing_is_named(
    missing: str, error: type[WhereToLookError], named: str, scene_folder: Path, tmp_path: Path
) -> None:
    from wheretolook_paper.benchmark.command import run

    scene = remade(scene_folder, tmp_path)
    (shutil.rmtree if (scene / missing).is_dir() else Path.unlink)(scene / missing)
    with pytest.raises(error) as caught:
        run([str(scene), "--out", str(tmp_path / "out"), "--workers", "1", "--methods", "max-visibility-shipped"])
    assert str(caught.value.path).endswith(named)


def test_a_map_of_several_cameras_is_left_to_the_benchmarks_localizer(scene_folder: Path, tmp_path: Path) -> None:
    import pycolmap

    from wheretolook_paper.benchmark.command import run

    scene = remade(scene_folder, tmp_path)
    model = pycolmap.Reconstruction(str(scene / "scene_reconstruction"))
    other = pycolmap.Camera(model.cameras[min(model.cameras)].todict())
    other.camera_id = 7
    other.params = other.params * 1.5
    model.add_camera_with_trivial_rig(other)
    model.write(str(scene / "scene_reconstruction"))
    given = [str(scene), "--out", str(tmp_path / "out"), "--workers", "1", "--methods", "max-visibility-shipped"]
    with pytest.raises(MapError, match="have one camera") as caught:
        run(given)
    assert "--localizer none" in str(caught.value)
    assert run([*given, "--localizer", "none"]) == 0


def test_a_mesh_in_another_frame_is_refused(
    scene_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from dataclasses import replace

    from wheretolook.scenes.loading import save_glb

    mesh = load_mesh(scene_folder / "room.glb")
    turned = replace(mesh, vertices=np.ascontiguousarray(mesh.vertices[:, [0, 2, 1]] + np.float32(1)))
    save_glb(turned, tmp_path / "turned.glb")
    assert benchmark(scene_folder, tmp_path / "out", "--mesh", str(tmp_path / "turned.glb")) == 2
    assert "do not lie on one another" in capsys.readouterr().err


@pytest.mark.parametrize("line", ["a/b 1 1 1", "1 1 1 1", ".hidden 1 1 1"])
def test_ids_name_files(line: str, scene_folder: Path, tmp_path: Path) -> None:
    scene = remade(scene_folder, tmp_path)
    (scene / "waypoints.txt").write_text(f"1 2.5 2.0 1.3\n{line}\n")
    assert benchmark(scene, tmp_path / "out") == 2


@pytest.mark.parametrize(
    "options", [["--localizer", "hloc"], ["--methods", "nobody"], ["--lattice", "cube"], ["--max-turn", "-1"], ["--x"]]
)
def test_options_are_checked(options: list[str], scene_folder: Path, tmp_path: Path) -> None:
    from wheretolook_paper.benchmark.command import run

    with pytest.raises(ConfigError):
        run([str(scene_folder), "--out", str(tmp_path), *options])


def test_files_of_others_are_not_replaced(scene_folder: Path, tmp_path: Path) -> None:
    kept = tmp_path / scene_folder.name / "best" / "images" / "holiday.png"
    kept.parent.mkdir(parents=True)
    kept.write_bytes(b"")
    assert benchmark(scene_folder, tmp_path, "--methods", "best") == 2
    assert kept.is_file()
