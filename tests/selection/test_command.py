"""`wheretolook select` on the command line."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
import pytest
import warp as wp

import wheretolook
from selection.room import POINTS, WEIGHTS
from wheretolook.cli import main
from wheretolook.visibility.listing import compile_kernels

SOURCE = {**os.environ, "PYTHONPATH": str(Path(wheretolook.__file__).parents[1])}  # for other processes
QUICK = ["--weights", str(WEIGHTS), "--directions", "60", "--device", "cpu"]


@pytest.fixture
def at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    np.savetxt(tmp_path / "at.csv", POINTS, delimiter=",", header="x,y,z", comments="")
    return tmp_path / "at.csv"


def test_a_table_of_views(sparse: Path, at: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["select", "--map", str(sparse), "--at", str(at), "--out", "views.csv", "--n", "2", *QUICK]) == 0
    table = pd.read_csv("views.csv")
    np.testing.assert_allclose(table[["x", "y", "z"]].to_numpy()[::2], POINTS)
    assert (table["rank"] == [1, 2] * 4).all() and (table["score"] > 0).all()
    assert "8 views" in capsys.readouterr().out


def test_a_sequence_and_a_grid(sparse: Path, at: Path) -> None:
    given = ["--map", str(sparse), *QUICK]
    assert main(["select", "--at", "at.csv", "--out", "way.tum", "--max-turn", "40", *given]) == 0
    assert np.loadtxt("way.tum").shape == (4, 8)
    assert main(["select", "--grid", "1", "--format", "benchmark", "--out", "poses.txt", "--fov", "60", *given]) == 0
    assert np.loadtxt("poses.txt").shape[1] == 8


@pytest.mark.parametrize(
    "arguments",
    [
        ["--at", "at.csv", "--out", "v.csv"],
        ["--map", "nowhere", "--at", "at.csv", "--out", "v.csv"],
        ["--map", "nowhere", "--at", "at.csv", "--out", "v.csv", "--n", "0"],
        ["--map", "nowhere", "--at", "at.csv", "--out", "v.csv", "--pitch", "30", "-30"],
        ["--map", "nowhere", "--at", "at.csv", "--out", "v.csv", "--max-turn", "-1"],
        ["--map", "SPARSE", "--out", "v.csv"],
        ["--map", "SPARSE", "--at", "at.csv", "--grid", "1", "--out", "v.csv"],
        ["--map", "SPARSE", "--at", "gone.csv", "--out", "v.csv"],
        ["--map", "SPARSE", "--at", "1,2", "--out", "v.csv"],
        ["--map", "SPARSE", "--at", "1,2,x", "1,2,3", "--out", "v.csv"],
        ["--map", "SPARSE", "--at", "1,2,300", "--out", "v.csv"],
        ["--map", "SPARSE", "--at", "at.csv", "--out", "v.txt"],
        ["--map", "SPARSE", "--at", "at.csv", "--out", "v.csv", "--camera", "MAGIC,1,2"],
        ["--map", "SPARSE", "--at", "at.csv", "--out", "v.csv", "--fov", "60", "--camera-id", "1"],
        ["--map", "SPARSE", "--at", "at.csv", "--out", "v.csv", "--size", "640x480"],
        ["--map", "SPARSE", "--at", "at.csv", "--out", "v.csv", "--fov", "60", "--size", "big"],
        ["--map", "SPARSE", "--at", "at.csv", "--out", "v.csv", "--nn", "2"],
        ["--map", "SPARSE", "--at", "at.csv", "--out", "v.csv", "--n", "two"],
        ["--map", "SPARSE", "--at", "at.csv", "--out", "v.csv", "--method", "magic"],
    ],
)
def test_bad_input(arguments: list[str], sparse: Path, at: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = [str(sparse) if argument == "SPARSE" else argument for argument in arguments]
    assert main(["select", *given]) == 2
    error = capsys.readouterr().err
    assert error.startswith("wheretolook: error: ") and error.count("\n") == 1
    assert not Path("v.csv").exists()


def test_a_first_score_loads_no_training(sparse: Path) -> None:
    code = "import sys; from wheretolook import WhereToLook\n"
    code += f"WhereToLook.from_colmap({str(sparse)!r}, device='cpu', occlusion='none').best((2, 2, 1.5))\n"
    code += "print([m for m in ('lightning', 'mlflow', 'sklearn', 'open3d', 'matplotlib') if m in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=SOURCE)
    assert ran.stdout.splitlines()[-1] == "[]"


def test_kernels_are_compiled_beside_the_start(sparse: Path, at: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded: set[str] = set()
    launched: set[str] = set()
    load = wp.load_module
    launch = wp.launch

    def note_load(module: ModuleType, **options: Any) -> None:
        loaded.add(module.__name__)
        load(module, **options)

    def note_launch(kernel: Any, *arguments: Any, **options: Any) -> Any:
        assert kernel.module.name in loaded, kernel.key  # it would be compiled now, while nothing else is done
        launched.add(kernel.module.name)
        return launch(kernel, *arguments, **options)

    monkeypatch.setattr(wp, "launch", note_launch)
    for camera in ([], ["--camera", "SIMPLE_RADIAL,640,480,320,320,240,0.01"]):
        loaded.clear()
        launched.clear()
        with monkeypatch.context() as patch:
            patch.setattr(wp, "load_module", note_load)
            compile_kernels("cpu")
        assert main(["select", "--map", str(sparse), "--at", "at.csv", "--out", "v.csv", *camera, *QUICK]) == 0
        assert "wheretolook.visibility.listing_kernel" in launched
