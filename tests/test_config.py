"""Every configuration that ships parses, and a wrong one says where."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from wheretolook import cli
from wheretolook.cli import main, parse_experiment
from wheretolook.config import MOVED, Experiment, MeshSource
from wheretolook.mapping.config import MapConfig, WalkConfig
from wheretolook.utils import devices
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.options import all_options, nearest

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
        (["map", "--config", "nowhere.yaml"], "nowhere.yaml: there is no such file"),
        (["map", "--config", str(CONFIGS / "demo.yml")], "there is no such file"),
        (["mapp"], "Did you mean map?"),
        (["map", "--map.n_imagess", "3"], "(got '--map.n_imagess'). Did you mean --map.n_images?"),
        (["map", "--map.n_image", "3"], "Did you mean --map.n_images?"),  # no abbreviations
        (["label", "--label.work", "3"], "Did you mean --label.workers?"),
        (["map", "--n_images=3"], "Did you mean --map.n_images?"),
        (["plan", "--metod", "set"], "Did you mean --method?"),
        (["scenes", "--device", "gpu"], "unknown device (got 'gpu')"),
        (["map", "--config"], "--config"),
        (["map", "--map.n_images", "many"], "many"),
        (["scenes", "--camera.width", "0"], "positive image size"),
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


def test_a_file_of_one_group_is_read_with_the_same_limits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good, wrong, bomb = (tmp_path / f"{name}.yaml" for name in ("good", "wrong", "bomb"))
    good.write_text("n_images: 7\nwalk: {coverage: 0.5}\n")
    wrong.write_text("n_imagez: 7\n")
    aliases = [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 9)]
    bomb.write_text("\n".join(["a0: &a0 [x, x, x, x, x, x, x, x, x]", *aliases]) + "\n")
    for arguments in (["--map", str(good)], [f"--map={good}"]):
        experiment = parse_experiment("map", arguments)
        assert experiment is not None and (experiment.map.n_images, experiment.map.walk.coverage) == (7, 0.5)
    written_out = parse_experiment("map", ["--map", '{"n_images": 8}'])
    assert written_out is not None and written_out.map.n_images == 8
    for path, said in (
        (wrong, "Did you mean map.n_images?"),
        (bomb, "aliases written out"),
        (Path("/dev/zero"), "a device"),
        (tmp_path / "none.yaml", "no such file"),
    ):
        assert main(["map", "--map", str(path)]) == 2
        errors = capsys.readouterr().err
        assert said in errors and str(path) in errors
    assert main(["map", "--map.walk", str(bomb)]) == 2


def test_an_unknown_key_names_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "experiment.yaml"
    path.write_text("map:\n  n_imagess: 3\n")
    assert main(["map", "--config", str(path)]) == 2
    errors = capsys.readouterr().err
    assert f"{path}: there is no such option (got 'map.n_imagess'). Did you mean map.n_images?" in errors


@pytest.mark.parametrize("place", ["map.n_images", "Photographs come from a folder now."])
def test_an_option_that_has_moved_says_where(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(MOVED, "map.images", place)
    path = tmp_path / "experiment.yaml"
    path.write_text("map: {images: 3}\n")
    for arguments in (["--map.images", "3"], ["--config", str(path)], ["--map.image", "3"]):
        assert main(["map", *arguments]) == 2
        assert (place if " " in place else f"{place} now.") in capsys.readouterr().err


def test_where_options_have_moved_to_is_there() -> None:
    options = all_options(Experiment)
    assert [old for old in MOVED if old in options] == []
    assert [new for new in MOVED.values() if " " not in new and new not in options] == []


def test_constants_are_recorded_with_the_settings() -> None:
    values = MapConfig(n_images=7, walk=WalkConfig(coverage=0.5)).record()
    assert values["walk"]["cell_m"] == 0.3 and values["partners"] == 10  # so that keys of finished maps stay the same


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


@pytest.mark.parametrize("stage", cli.STAGES)
@pytest.mark.parametrize(("name", "gpus", "says"), [("cuda", 0, "--device cpu"), ("cuda:3", 1, "cuda:0 is the first")])
def test_a_gpu_that_is_not_there_is_refused_at_once(
    stage: str, name: str, gpus: int, says: str,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr(devices, "_driver_gpus", lambda: gpus)
    monkeypatch.setattr(devices, "_torch_gpus", lambda: gpus)
    arguments = ["--config", str(CONFIGS / "demo.yaml"), "--data", str(tmp_path), "--device", name]
    assert main([stage, *arguments]) == 2
    assert says in capsys.readouterr().err and not [*tmp_path.iterdir()]


def test_devices_that_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "_driver_gpus", lambda: 2)
    monkeypatch.setattr(devices, "_torch_gpus", lambda: 2)
    assert [devices.usable_device(name) for name in ("auto", "cpu", "cuda", "cuda:1")] == [
        "cuda", "cpu", "cuda", "cuda:1"
    ]  # fmt: skip
    monkeypatch.setattr(devices, "_torch_gpus", lambda: 0)
    assert devices.usable_device("auto") == "cpu"
    with pytest.raises(ConfigError, match="built for the CPU"):
        devices.usable_device("cuda")


def test_the_machines_of_a_cluster_may_have_gpus_that_this_one_has_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "_driver_gpus", lambda: 0)
    experiment = parse_experiment("label", ["--engine", "ray", "--device", "cuda"])
    assert experiment is not None and experiment.warp_device == "cuda"


HEAVY = ("torch", "warp", "scipy", "matplotlib", "mlflow", "pandas", "sklearn", "lightning", "cv2", "jsonargparse")


@pytest.mark.parametrize(
    "arguments",
    [["--help"], ["--version"], ["label", "--help"], ["demo", "--help-all"], ["train", "--train.epoch", "10"]],
)
def test_what_needs_no_work_loads_nothing_heavy(arguments: list[str], tmp_path: Path) -> None:
    code = f"""import sys
sys.path.insert(0, {str(Path(cli.__file__).parents[1])!r})
from wheretolook.cli import main
main({arguments!r})
print([name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr)"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert done.stderr.splitlines()[-1] == "[]"
    assert "--train.epoch'" in done.stderr if "--train.epoch" in arguments else done.stdout


@pytest.mark.parametrize(
    ("wrong", "meant"),
    [
        ("map.n_imags", "map.n_images"),
        ("n_images", "map.n_images"),
        ("label.max_ratio", "label.localizer.max_ratio"),
        ("map.max_sides_px", "map.photographs.max_side_px"),
        ("sample.gird", "sample.grid"),
        ("frobnicate", None),
    ],
)
def test_the_nearest_option_is_named(wrong: str, meant: str | None) -> None:
    assert nearest(wrong, all_options(Experiment)) == meant


def test_debug_shows_the_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenes", "--camera.width", "0", "--debug"]) == 2
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize("stage", cli.STAGES)
def test_every_stage_explains_itself(
    stage: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    assert main([stage, "--help-all", "--config", str(CONFIGS / "demo.yaml")]) == 0
    text = capsys.readouterr().out
    for group in cli.STAGES[stage].groups:
        assert f"--{group}" in text
    assert ("--label.shard_size" in text) == (stage in ("label", "adapt", "compare-paths", "demo"))
    assert "--map.walk.cell_m" not in text  # a constant
    monkeypatch.setenv("COLUMNS", "80")
    assert main([stage, "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 40 and max(map(len, lines)) <= 120
    assert any(line.startswith(f"  wheretolook {stage} -") for line in lines)


def test_usage_lists_every_stage(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(f"\n  {stage} " in text for stage in cli.STAGES)
