"""A wheel, made of the source distribution and installed away from the checkout, is all that a user needs."""

import shutil
import subprocess
import sys
import tarfile
import zipfile
from email import message_from_string
from pathlib import Path

import pytest

from wheretolook.utils.package import VERSION

pytestmark = pytest.mark.slow  # half a minute

ROOT = Path(__file__).parents[1]
SETTLED = "pyproject.toml", "README.md", "LICENSE"

BUILD = """import sys
from setuptools import build_meta
print(getattr(build_meta, sys.argv[1])(sys.argv[2]))"""

FIRST_SCORE = """
import sys
import numpy as np
import wheretolook
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.mapping.landmarks import Landmarks
from wheretolook import LocalizationMap, Map, load_scorer, poses_looking_along

assert wheretolook.__file__.startswith(sys.argv[1]), wheretolook.__file__
n = 400
points = np.random.default_rng(0).uniform((2, -1, 0), (3, 1, 2), (n, 3))
ones = np.ones(n, np.float32)
directions = ((points - (0, 0, 1)) / np.linalg.norm(points - (0, 0, 1), axis=1, keepdims=True)).astype(np.float32)
landmarks = Landmarks(np.arange(n), points, np.full(n, 5, np.int32), 0.2 * ones, 15 * ones, directions, 0.02 * ones,
                      2.5 * ones, 0.1 * ones, None, 0.5 * ones, 160 * ones)
scorer = load_scorer(LocalizationMap(Map(landmarks), PinholeCamera(320, 240, 160.0)))
there, away = scorer.score(poses_looking_along([[0, 0, 1], [0, 0, 1]], [[1, 0, 0], [-1, 0, 0]]))
print(scorer.name, there > 0.5 > away)
"""


def ran(arguments, folder, installed=None):
    """What a Python process says that was started in a folder, with what is installed there before all else."""
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(folder)} | ({"PYTHONPATH": str(installed)} if installed else {})
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, cwd=folder, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Made without network: the checkout's files, of them the source distribution, and of that alone the wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    checkout = folder / "checkout"
    ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for name in ("src", "configs", "data/release/weights"):
        shutil.copytree(ROOT / name, checkout / name, symlinks=True, ignore=ignored)
    for name in SETTLED:
        shutil.copy(ROOT / name, checkout)
    source = ran(["-c", BUILD, "build_sdist", str(folder)], checkout).splitlines()[-1]
    with tarfile.open(folder / source) as archive:
        archive.extractall(folder, filter="data")
    unpacked = folder / source.removesuffix(".tar.gz")
    assert not any(path.is_symlink() for path in unpacked.rglob("*"))
    return folder / ran(["-c", BUILD, "build_wheel", str(folder)], unpacked).splitlines()[-1]


@pytest.fixture(scope="module")
def installed(wheel):
    target = wheel.parent / "site"
    offline = ["--no-deps", "--no-index", "--disable-pip-version-check", "--quiet"]
    ran(["-m", "pip", "install", *offline, "--target", str(target), str(wheel)], wheel.parent)
    return target


def test_it_carries_all_modules_and_what_they_need(wheel):
    assert wheel.name == f"wheretolook-{VERSION}-py3-none-any.whl"
    assert wheel.stat().st_size < 4e6
    with zipfile.ZipFile(wheel) as archive:
        files = {name for name in archive.namelist() if name.startswith("wheretolook/")}
        about = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        metadata = message_from_string(archive.read(about).decode())
        assert any(name.endswith("licenses/LICENSE") for name in archive.namelist())
        points = archive.read(about.replace("METADATA", "entry_points.txt")).decode()
    package = ROOT / "src" / "wheretolook"
    modules = {f"wheretolook/{path.relative_to(package)}" for path in package.rglob("*.py")}
    place = "wheretolook/shipped"
    configs = {f"{place}/configs/{path.name}" for path in (ROOT / "configs").glob("*.yaml")}
    weights = {
        f"{place}/data/release/weights/{name}.{suffix}"
        for name in ("set", "matchability", "mlp-2d+z", "aliked/set", "aliked/matchability")
        for suffix in ("json", "safetensors")
    }
    fitted = (
        "localization/confidence",
        "localization/missing",
        "looks/set_score",
        "scorers/set/accuracy",
        "scorers/set/photographs",
    )
    numbers = {f"wheretolook/{name}.json" for name in fitted}
    assert files == {*modules, *configs, *weights, *numbers, "wheretolook/py.typed"}
    assert metadata["License-Expression"] == "Apache-2.0" and "wheretolook = wheretolook.cli:main" in points


def test_commands_run_in_an_empty_folder(installed, tmp_path):
    command = ["-c", "import sys; from wheretolook.cli import main; sys.exit(main(sys.argv[1:]))"]
    assert "\n  demo " in ran([*command, "--help"], tmp_path, installed)
    assert ran([*command, "--version"], tmp_path, installed).split() == ["wheretolook", VERSION]
    assert "usage: wheretolook demo" in ran([*command, "demo", "--help"], tmp_path, installed)
    printed = ran([*command, "scenes", "--config", "configs/small.yaml", "--help"], tmp_path, installed)
    assert "usage: wheretolook scenes" in printed
    experiment = "from wheretolook.cli import parse_command; print(parse_command('demo', []).root)"
    assert ran(["-c", experiment], tmp_path, installed).strip() == "data/demo"
    assert not [*tmp_path.iterdir()]


def test_a_map_is_scored_by_the_weights_in_it(installed, tmp_path):
    said = ran(["-c", FIRST_SCORE, str(installed)], tmp_path, installed)
    assert said.split() == ["set", "True"]
