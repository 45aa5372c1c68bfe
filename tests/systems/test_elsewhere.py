"""The commands run where Linux's and POSIX's functions, modules, signals and files are missing, with the same result."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from selection.room import POINTS, WEIGHTS, write_room
from stages.test_pipeline import EXPERIMENT
from wheretolook.cli import main
from wheretolook.dataset.layout import Dataset

SCRIPT = Path(__file__).with_name("elsewhere.py")


def run_elsewhere(folder, *commands):
    """Run commands in a folder, in one process. Returns what they print."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    run = [sys.executable, str(SCRIPT), json.dumps(commands)]
    done = subprocess.run(run, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_select_and_score(tmp_path):
    sparse = write_room(tmp_path / "sparse")
    np.savetxt(tmp_path / "at.csv", POINTS, delimiter=",", header="x,y,z", comments="")
    given = ["--map", str(sparse), "--weights", str(WEIGHTS), "--device", "cpu"]
    select = ["select", *given, "--at", str(tmp_path / "at.csv"), "--directions", "60", "--out"]
    run_elsewhere(tmp_path, [*select, "views.csv"], ["score", *given, "--poses", "views.csv", "--out", "scores.csv"])
    assert main([*select, str(tmp_path / "here.csv")]) == 0
    views, scores, here = (pd.read_csv(tmp_path / name) for name in ("views.csv", "scores.csv", "here.csv"))
    pd.testing.assert_frame_equal(views, here)
    np.testing.assert_allclose(scores["score"], here["score"], atol=1e-5)


@pytest.mark.slow
def test_from_scenes_to_evaluation(tmp_path):
    (tmp_path / "tiny.yaml").write_text(
        EXPERIMENT.replace("workers: 1", "workers: 2")
        .replace("[mlp-2d, mlp-2d+3d, set]", "[mlp-2d]")
        .replace("mlp, set]", "mlp]")
    )
    stages = ("scenes", "map", "sample", "label", "train", "evaluate")
    run_elsewhere(tmp_path, *([stage, "--config", "tiny.yaml", "--device", "cpu"] for stage in stages))
    dataset = Dataset.load(tmp_path / "data" / "tiny")
    assert not any((scene.read_table()["status"] == "unlabelled").any() for scene in dataset.scenes)
    assert {"random", "visible", "mlp-2d"} <= {*pd.read_csv(dataset.root / "results" / "scores.csv")["method"]}
    assert not list(dataset.root.glob(".*"))  # no lock is left
    assert (tmp_path / "mlruns" / "mlflow.db").is_file()


@pytest.mark.parametrize("name", ["sched_getaffinity", "fcntl", "SIGALRM", "/proc/meminfo"])
def test_what_elsewhere_lacks_is_missing(name, tmp_path):
    """Otherwise the tests above would pass on Linux in any case."""
    code = {
        "sched_getaffinity": "import os; os.sched_getaffinity(0)",
        "fcntl": "import fcntl",
        "SIGALRM": "import signal; signal.SIGALRM",
        "/proc/meminfo": "from pathlib import Path; Path('/proc/meminfo').read_text()",
    }[name]
    package = tmp_path / "wheretolook_of_linux.py"
    package.write_text(code)
    test = f"import runpy, sys; runpy.run_path({str(SCRIPT)!r}); import wheretolook_of_linux"
    done = subprocess.run([sys.executable, "-c", test], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith(("AttributeError", "ModuleNotFoundError", "FileNotFoundError"))
