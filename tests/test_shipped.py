"""What ships with the package is found under its name in any folder, and scores without being asked for."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import wheretolook
from synthetic_dataset import CAMERA, make_landmarks
from wheretolook import LocalizationMap, Map, load_scorer, poses_looking_along
from wheretolook.cli import parse_command
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import fingerprint
from wheretolook.utils.package import WEIGHTS, or_shipped, shipped, shipped_configs

ROOT = Path(__file__).parents[1]


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """An empty folder that everything is started in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_what_ships_is_what_lies_in_the_project():
    assert shipped_configs() == sorted(f"configs/{path.name}" for path in (ROOT / "configs").glob("*.yaml"))
    weights = [path.name for path in sorted((ROOT / WEIGHTS).glob("*.safetensors"))]
    assert "set.safetensors" in weights
    for name in [*shipped_configs(), *(f"{WEIGHTS}/{name}" for name in weights)]:
        assert fingerprint(shipped(name)) == fingerprint(ROOT / name)
    with pytest.raises(ConfigError, match=r"configs/none\.yaml: this file is not bundled"):
        shipped("configs/none.yaml")


def test_files_of_ones_own_come_first(elsewhere):
    name = "configs/demo.yaml"
    assert or_shipped(name) == shipped(name)
    for path in ("configs/none.yaml", "../configs/demo.yaml", str(elsewhere / name)):
        assert or_shipped(path) == Path(path)
    (elsewhere / "configs").mkdir()
    (elsewhere / name).write_text("name: mine\n")
    assert or_shipped(name) == Path(name)
    experiment = parse_command("map", ["--config", name])
    assert experiment is not None and experiment.name == "mine"
    # the demo is ours, whatever lies in that folder
    demo = parse_command("demo", [])
    assert demo is not None and demo.name == "demo"


@pytest.mark.usefixtures("elsewhere")
def test_a_map_is_scored_by_the_weights_that_ship():
    localization_map = LocalizationMap(Map(make_landmarks(np.random.default_rng(0), 200)), CAMERA)
    rng = np.random.default_rng(1)
    views = poses_looking_along(rng.uniform((-1, -1, 1), (1, 1, 2), (20, 3)), rng.normal(size=(20, 3)))
    scorer = load_scorer(localization_map)
    assert scorer.name == "set"
    expected = load_scorer(localization_map, ROOT / WEIGHTS / "set.safetensors").score(views)
    for same in (scorer, load_scorer(localization_map, WEIGHTS)):
        np.testing.assert_array_equal(same.score(views), expected)


def test_public_names_are_there_and_cost_nothing_until_they_are_used():
    code = """import sys
import wheretolook
print(sorted(name for name in sys.modules if name.partition(".")[0] not in sys.stdlib_module_names))
print([name for name in wheretolook.__all__ if not hasattr(wheretolook, name)])
from wheretolook import load_scorer
from wheretolook.scorers.set.score import SetScorer
print([name for name in ("lightning", "mlflow", "sklearn", "matplotlib", "ray") if name in sys.modules])"""
    path = str(Path(wheretolook.__file__).parents[1])
    code = f"import sys; sys.path.insert(0, {path!r})\n{code}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    own, missing, heavy = done.stdout.splitlines()
    modules = [name for name in eval(own) if name.startswith("wheretolook")]
    assert modules == ["wheretolook", "wheretolook.utils", "wheretolook.utils.errors", "wheretolook.utils.package"]
    assert not {"torch", "numpy", "warp", "pandas"} & set(eval(own))
    assert missing == "[]" and heavy == "[]"
