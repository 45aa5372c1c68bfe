"""`wheretolook select` on the command line."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
import pytest
from matplotlib.quiver import Quiver

import wheretolook
from selection.room import POINTS, WEIGHTS, write_room
from wheretolook.cli import main
from wheretolook.utils.errors import MapWarning

SOURCE = {**os.environ, "PYTHONPATH": str(Path(wheretolook.__file__).parents[1])}  # for other processes
QUICK = ["--weights", str(WEIGHTS), "--directions", "60", "--device", "cpu"]


@pytest.fixture
def at(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.savetxt(tmp_path / "at.csv", POINTS, delimiter=",", header="x,y,z", comments="")
    return tmp_path / "at.csv"


def test_views_and_scores_of_poses(sparse, at, capsys):
    given = ["--map", str(sparse), "--weights", str(WEIGHTS), "--device", "cpu"]
    written = {"views.csv": [], "views.tum": [], "views.json": [], "p.txt": ["--format", "benchmark"], "folder": []}
    for name, options in written.items():
        assert main(["select", "--at", "at.csv", "--out", name, "--directions", "60", *options, *given]) == 0
        assert "views: 4 in" in capsys.readouterr().out
    expected = pd.read_csv("views.csv")
    np.testing.assert_allclose(expected[["x", "y", "z"]], POINTS)
    for name in written:
        assert main(["score", "--poses", name, "--out", "scores.csv", *given]) == 0
        found = pd.read_csv("scores.csv")
        np.testing.assert_allclose(found["score"], expected["score"], atol=1e-5)
        np.testing.assert_array_equal(found[["waypoint", "n_visible"]], expected[["waypoint", "n_visible"]])
    Path("far.tum").write_text("7 1000 0 0 0 0 0 1\n" + Path("views.tum").read_text())
    assert main(["score", "--poses", "far.tum", "--out", "scores.csv", *given]) == 2
    assert "waypoint 7: (1000, 0, 0)" in capsys.readouterr().err
    assert main(["score", "--poses", "far.tum", "--out", "scores.csv", "--skip", *given]) == 0
    assert pd.read_csv("scores.csv")["waypoint"].tolist() == [0, 1, 2, 3]
    Path("robot.tum").write_text("".join(f"{row} {x} {y} {z} 0 0 0 1\n" for row, (x, y, z) in enumerate(POINTS)))
    with pytest.warns(MapWarning, match="robot's base"):
        assert main(["score", "--poses", "robot.tum", "--out", "scores.csv", *given]) == 0
    assert pd.read_csv("scores.csv")["pitch_deg"].tolist() == [0] * 4
    assert main(["score", "--poses", "robot.tum", "--frame", "camera", "--out", "scores.csv", *given]) == 0
    assert pd.read_csv("scores.csv")["pitch_deg"].tolist() == [90] * 4


def test_images_of_several_cameras_are_scored_for_their_own(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    model = pycolmap.Reconstruction(write_room(tmp_path / "sparse"))
    wide = pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=[200, 320, 240], camera_id=2)
    model.add_camera_with_trivial_rig(wide)
    first, *_, last = sorted(model.images)
    (tmp_path / "two").mkdir()
    model.write_text(str(tmp_path / "two"))
    text = (tmp_path / "two" / "images.txt").read_text()
    given = ["--device", "cpu", "--weights", str(WEIGHTS)]
    name = model.images[last].name
    (tmp_path / "two" / "images.txt").write_text(text.replace(f" 1 {name}", f" 2 {name}"))
    for path in ("rigs.txt", "frames.txt"):
        (tmp_path / "two" / path).unlink(missing_ok=True)
    assert main(["score", "--map", "two", "--scale", "1", "--poses", "two", "--out", "own.csv", *given]) == 0
    own = pd.read_csv("own.csv").set_index("waypoint")
    assert own["camera_id"].value_counts().to_dict() == {1: 11, 2: 1}
    for number, image in ((1, model.images[first].name), (2, name)):
        options = ["--camera-id", str(number), "--out", "one.csv", *given]
        assert main(["score", "--map", "two", "--scale", "1", "--poses", "two/images.txt", *options]) == 0
        one = pd.read_csv("one.csv").set_index("waypoint")
        assert one["score"][image] == pytest.approx(own["score"][image], abs=1e-6)
    assert one["score"][model.images[first].name] != pytest.approx(own["score"][model.images[first].name], abs=1e-6)
    Path("far.txt").write_text("elsewhere.jpg 1 0 0 0 -2 -2 -1.5\n")
    assert main(["score", "--map", "two", "--scale", "1", "--poses", "far.txt", "--out", "s.csv", *given]) == 2
    assert "2 cameras" in capsys.readouterr().err
    assert main(["score", "--map", "two", "--scale", "1", "--poses", "far.txt", "--out", "folder", *given]) == 2
    assert "one camera" in capsys.readouterr().err  # before poses are scored


def test_a_floor_plan(sparse, at, look):
    given = ["--map", str(sparse), "--at", "at.csv", "--out", "views.csv", "--n", "2", *QUICK]
    assert main(["select", "--floor-plan", "plan.png", *given]) == 0
    assert Path("plan.png").read_bytes().startswith(b"\x89PNG")
    views = look.best(POINTS, 2)
    plan = look.floor_plan(views).axes[0]
    (arrows,) = (item for item in plan.collections if isinstance(item, Quiver))
    order = np.argsort(views.score, kind="stable")
    np.testing.assert_allclose(arrows.XY, views.positions[order, :2])
    np.testing.assert_allclose(np.arctan2(arrows.V, arrows.U), np.radians(views.yaw_deg[order]))
    assert [text.get_text() for text in plan.texts] == ["0", "1", "2", "3"]
    Path("views.csv").unlink()
    assert main(["select", "--floor-plan", "plan.gif", *given]) == 2 and not Path("views.csv").exists()


def test_a_sequence_and_a_grid(sparse, at):
    given = ["--map", str(sparse), *QUICK]
    assert main(["select", "--at", "at.csv", "--out", "way.tum", "--max-turn", "40", *given]) == 0
    assert np.loadtxt("way.tum").shape == (4, 8)
    assert main(["select", "--grid", "1", "--format", "benchmark", "--out", "poses.txt", "--fov", "60", *given]) == 0
    assert np.loadtxt("poses.txt").shape[1] == 8


@pytest.mark.parametrize(
    "arguments",
    [
        "--at at.csv", "--map nowhere --at at.csv", "--map SPARSE", "--map SPARSE --at at.csv --grid 1",
        "--map SPARSE --at gone.csv", "--map SPARSE --at 1,2,300", "--map SPARSE --at at.csv --format xml",
        "--map SPARSE --at at.csv --camera MAGIC,1,2", "--map SPARSE --at at.csv --camera at.csv", "--map SPARSE --at at.csv --fov 60 --camera-id 1",
        "--map SPARSE --at at.csv --fov 60 --size big", "--map SPARSE --at at.csv --nn 2",
        "--map SPARSE --at 1 2 1.5", "--map SPARSE --at at.csv --mesh-up y",
    ],
)  # fmt: skip
def test_invalid_arguments_exit_with_two_and_one_line(arguments, sparse, at, capsys):
    assert main(["select", "--out", "v.csv", *arguments.replace("SPARSE", str(sparse)).split()]) == 2
    error = capsys.readouterr().err
    assert error.startswith("wheretolook: error: ") and error.count("\n") == 1
    assert not Path("v.csv").exists()


def test_a_first_score_loads_no_training(sparse):
    code = "import sys; from wheretolook import WhereToLook\n"
    code += f"WhereToLook.from_colmap({str(sparse)!r}, device='cpu', occlusion='none').best((2, 2, 1.5))\n"
    code += "print([m for m in ('lightning', 'mlflow', 'sklearn', 'open3d', 'matplotlib') if m in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=SOURCE)
    assert ran.stdout.splitlines()[-1] == "[]"
