"""Every benchmark runs once at small size."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[1]
WEIGHTS = ROOT / "data" / "release" / "weights" / "set.safetensors"

pytestmark = pytest.mark.slow

SMALL = {
    "campus": "--rooms 2 --voxels 8 --processes 1",
    "looks": f"--scene {ROOT}/data/release/apartment-209 --directions 30 --places 2",
    "robot": f"--weights {WEIGHTS} --landmarks 500 --directions 20 --repeats 2",
    "scale": "--landmarks 500 5000 --locations 1 2 --repeats 1 --out /dev/null",
    "scorers": f"--weights {WEIGHTS} --landmarks 500 --locations 2 --directions 20 --repeats 1 --poses 2",
    "select": "--landmarks 400 --waypoints 2 --repeats 1",
    "view": "--landmarks 400 --turns 2 --clients 1 --seconds 4",
    "viewpoint_map": "--landmarks 300 --voxels 4 --directions 20 --repeats 1 --builds 1 --queries 100 --waypoints 5",
}


def run(name, *arguments):
    """Run a benchmark; return what it prints."""
    command = [sys.executable, str(FOLDER / f"bench_{name}.py"), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize("name", SMALL)
def test_small(name):
    assert run(name, *SMALL[name].split())


def test_visibility_is_measured_and_drawn(tmp_path):
    out = tmp_path / "cpu.json"
    sizes = "--locations 4 --directions 20 --landmarks 300 --triangles 500 --repeats 1 --twin-repeats 1"
    scaling = "--scaling --scaling-limit 1000 --scaling-repeats 1"
    run("visibility", *sizes.split(), *scaling.split(), "--out", str(out))
    assert {"paper_size", "scaling"} < json.loads(out.read_text()).keys()
    run("visibility", "--draw", str(out), "--figures", str(tmp_path))
    assert {"runtimes.csv", "runtimes.png", "scaling.csv"} < {path.name for path in tmp_path.iterdir()}
    steps = tmp_path / "step.json"
    run("scorers", *SMALL["scorers"].split(), "--step", "--out", str(steps))
    for _ in range(2):  # a second measurement on the same machine replaces the first
        run("visibility", "--draw", str(tmp_path / "runtimes.csv"), str(steps), "--figures", str(tmp_path))
    times = pd.read_csv(tmp_path / "runtimes.csv")
    assert not times.duplicated(["what", "threads"]).any() and "counts alone" in {*times["what"]}
    times = times.set_index("what")
    pose, location = times.loc["set, one pose"], times.loc["set, one location"]
    assert (pose["directions"], location["directions"], pose["landmarks"]) == (1, 20, 500)
    assert 0 < pose["q1_s"] <= pose["median_s"] <= pose["q3_s"] <= pose["max_s"]


def test_features_and_labelling(tmp_path):
    sizes = ("--map-images", "12", "--locations", "2", "--directions", "2")
    assert "| opencv |" in run("features", "--work", str(tmp_path), *sizes)
    scene = tmp_path / "scene-901"
    shutil.copytree(scene / "opencv" / "map", scene / "map")
    assert "ms per view" in run("labelling", "--scene", str(scene), "--views", "8", "--batches", "4")


def test_the_ledger_compares_with_the_last_entry(tmp_path):
    sizes = "--locations 2 --landmarks 300 --triangles 500 --repeats 1"
    ledger = tmp_path / "ledger.csv"
    assert "first entry" in run("ledger", *sizes.split(), "--ledger", str(ledger), "--record")
    assert "first entry" not in run("ledger", *sizes.split(), "--ledger", str(ledger))
    assert len(ledger.read_text().splitlines()) == 11


def test_every_benchmark_is_run():
    names = {path.stem.removeprefix("bench_") for path in FOLDER.glob("bench_*.py")}
    assert names == {*SMALL, "features", "labelling", "ledger", "visibility"}
