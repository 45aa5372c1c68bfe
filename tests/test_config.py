"""Every configuration that ships parses, and a wrong one says where."""

from __future__ import annotations

from pathlib import Path

import pytest

from wheretolook import cli
from wheretolook.cli import main, parse_experiment
from wheretolook.config import MeshSource

CONFIGS = Path(__file__).parents[1] / "configs"


@pytest.mark.parametrize("name", ["demo", "apartments"])
def test_shipped_configurations_parse(name: str) -> None:
    experiment = parse_experiment("label", ["--config", str(CONFIGS / f"{name}.yaml")])
    assert experiment is not None and experiment.name == name


def test_the_command_line_overrides_the_file() -> None:
    experiment = parse_experiment(
        "sample", ["--config", str(CONFIGS / "demo.yaml"), "--sample.grid", "[4,5,6]", "--label.localizer.seed=7"]
    )
    assert experiment is not None
    assert experiment.sample.grid == (4, 5, 6) and experiment.label.localizer.seed == 7
    assert experiment.scenes.train == 3


def test_meshes_of_ones_own(tmp_path: Path) -> None:
    config = CONFIGS / "own-meshes.yaml"
    experiment = parse_experiment("scenes", ["--config", str(config), "--scenes.meshes", "[{path: a/b.glb, up: y}]"])
    assert experiment is not None and experiment.scenes.meshes == (MeshSource(Path("a/b.glb"), up="y"),)
    assert experiment.scenes.meshes[0].scene_name == "b"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["frobnicate"], "unknown stage (got 'frobnicate')"),
        (["map", "--config", "nowhere.yaml"], "nowhere.yaml"),
        (["map", "--map.n_imagess", "3"], "--map.n_imagess"),
        (["map", "--map.n_images", "many"], "many"),
        (["scenes", "--camera.width", "0"], "positive width"),
        (["sample", "--sample.lattice", "spiral"], "spiral"),
        (["scenes", "--config", str(CONFIGS / "own-meshes.yaml")], "needs scenes"),
    ],
)
def test_bad_settings_exit_with_two_and_no_traceback(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    errors = capsys.readouterr().err
    assert said in errors and "Traceback" not in errors


def test_an_unknown_key_names_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "experiment.yaml"
    path.write_text("map:\n  n_imagess: 3\n")
    assert main(["map", "--config", str(path)]) == 2
    errors = capsys.readouterr().err
    assert str(path) in errors and "n_imagess" in errors


@pytest.mark.parametrize(
    "text", ["map: 3\n", "map: [1, 2]\n", "label: {workers: -1}\n", "scenes: {meshes: [{path: ../x y}]}\n"]
)
def test_a_wrong_value_in_a_file_names_the_file(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "experiment.yaml"
    path.write_text(text)
    assert main(["map", "--config", str(path)]) == 2
    errors = capsys.readouterr().err
    assert str(path) in errors and "Traceback" not in errors


def test_own_meshes_without_weights_fail_before_any_work(capsys: pytest.CaptureFixture[str]) -> None:
    config = CONFIGS / "own-meshes.yaml"
    assert main(["demo", "--config", str(config), "--scenes.meshes", "[{path: a/b.glb}]"]) == 2
    assert "evaluate.weights" in capsys.readouterr().err


def test_debug_shows_the_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenes", "--camera.width", "0", "--debug"]) == 2
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize("stage", [*cli.STAGES, "demo"])
def test_every_stage_explains_itself(stage: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([stage, "--help", "--config", str(CONFIGS / "demo.yaml")]) == 0
    text = capsys.readouterr().out
    for group in cli.STAGES[stage][2] if stage in cli.STAGES else ():
        assert f"--{group}" in text
    assert ("--label.shard_size" in text) == (stage in ("label", "compare-paths", "demo"))


def test_usage_lists_every_stage(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(f"\n  {stage} " in text for stage in [*cli.STAGES, "demo"])
