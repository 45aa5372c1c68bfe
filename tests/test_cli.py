"""The command line: options from files and arguments, errors and exit codes, help, and which package imports which."""

import ast
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from wheretolook import cli
from wheretolook.cli import main, parse_command
from wheretolook.commands.options import Experiment, MeshSource
from wheretolook.mapping.config import MapConfig
from wheretolook.scorers.registry import describe_methods
from wheretolook.utils import devices
from wheretolook.utils.errors import ConfigError
from wheretolook_paper.release.catalog import ITEMS

ROOT = Path(__file__).parents[1]
CONFIGS = ROOT / "configs"


@pytest.mark.parametrize(
    "path", sorted({*CONFIGS.glob("*.yaml")} - {CONFIGS / "own-meshes.yaml"}), ids=lambda path: path.stem
)
@pytest.mark.parametrize("command", ["train", "release"])
def test_a_shipped_configuration_serves_every_command(path, command):
    Path("data").mkdir()
    Path("data", "release").symlink_to(ROOT / "data" / "release")
    assert parse_command(command, ["--config", str(path)]).name == path.stem


def test_arguments_override_the_file():
    options = parse_command(
        "demo", ["--sample.grid", "[4,5,6]", "--config", str(CONFIGS / "demo.yaml"), "--label.localizer.seed=7"]
    )
    assert options.sample.grid == (4, 5, 6)
    assert options.label.localizer.seed == 7
    assert options.scenes.train == 3


@pytest.mark.parametrize(
    ("command", "arguments", "name", "value"),
    [
        ("scenes", ["--scenes.meshes", "[{path: a/b.glb, up: y}]"], "scenes.meshes", (MeshSource(Path("a/b.glb"), up="y"),)),
        ("map", ["--mapping.camera.fov_deg", "60"], "mapping.camera.fov_deg", 60.0),
        ("map", ["--up", "-y", "--model", "a"], "up", "-y"),
        ("map", ["--mapping.existing.model", "a", "--mapping.frame.up", "-y"], "up", "-y"),
        ("plan", ["--plan.start", "[-4, -3, 1.4]", "--plan.stops.looks", "3"], "plan.stops.looks", 3),
        ("plan", ["--start", "[-4, -3, 1.4]"], "plan.start", (-4.0, -3.0, 1.4)),
        ("plan", ["--start", "-4,-3,1.4"], "plan.start", (-4.0, -3.0, 1.4)),
        ("plan", ["--goal", "0", "-3", "1.4"], "plan.goal", (0.0, -3.0, 1.4)),
        ("plan", ["--stops", "3"], "plan.stops.looks", 3),
        ("evaluate", ["--evaluate.weights", "[data/release/weights/set.safetensors]"], "evaluate.weights", None),
        ("select", ["--map", "m", "--out", "o.csv", "--at", "1,2,1.5", "-0.5,2,1.5"], "at", ("1,2,1.5", "-0.5,2,1.5")),
        ("select", ["--map", "m", "--out", "o.csv", "--at", "a.csv", "--pitch", "-30", "30"], "pitch_deg", (-30.0, 30.0)),
        ("select", ["--map", "m", "--out", "o.csv", "--grid", "1", "--camera-id", "3", "--skip"], "skip", True),
        ("benchmark", ["a", "b", "--methods", "best", "set"], "scenes", (Path("a"), Path("b"))),
        ("adapt", ["--map", "m", "--scale", "2"], "map", Path("m")),
        ("select", ["--map", "m", "--out", "o.csv", "--at", "a.csv", "--scale", "2", "--scale", "2"], "scale", 2),
    ],
)  # fmt: skip
def test_ways_to_write_options(command, arguments, name, value):
    found = parse_command(command, arguments)
    for part in name.split("."):
        found = getattr(found, part)
    assert found == value or value is None


def test_python_and_the_command_line_mean_the_same():
    arguments = ["--name", "a", "--mapping.n_images", "5", "--camera.fov_deg", "60"]
    parsed = parse_command("release", arguments)
    assert parsed.mapping == MapConfig(n_images=5)
    assert parsed.root == Experiment(name="a").root
    assert parsed.sample == Experiment().sample


@pytest.mark.parametrize(
    "arguments",
    [
        ["frobnicate"],
        ["map", "--config", "nowhere.yaml"],
        ["map", "--config"],
        ["map", "--mapping.n_images", "many"],
        ["map", "--mapping.n_images", "3", "4"],
        ["map", "--mapping.n_image", "3"],  # no abbreviations
        ["map", "--mapping.partners", "1"],  # a constant
        ["map", "--list-methods"],
        ["label", "--map", "sparse/0"],  # of other commands
        ["plan", "--map.n_images", "3"],
        ["plan", "--map", "nowhere", "--start", "[1, 1, 1]", "--goal", "[2, 1, 1]"],
        ["plan", "--mesh", "scan.glb"],  # of a map
        ["scenes", "--device", "gpu"],
        ["scenes", "--camera.width", "0"],
        ["scenes", "--config", str(CONFIGS / "own-meshes.yaml")],  # no scene
        ["demo", "--config", str(CONFIGS / "own-meshes.yaml"), "--scenes.meshes", "[{path: a/b.glb}]"],  # no weights
        ["viewpoint-map", "--lattice", "spiral"],
        ["plan", "--start", "[.nan, 1, 1]"],
        ["plan", "--plan.planner.time_s", ".inf"],
        ["select", "--map", "m", "--out", "o.csv"],
        ["release", "--name", "mine", "--release_name", "mine"],
        *(
            text.split()
            for text in (
                "select --map m --at 1,1,1",
                "select --map m --at 1,1,1 --out a.csv --n zero",
                "select --map m --at 1,1,1 --out a.csv --pitch 30",
                "select --map m --at 1,1,1 --out a.csv --pitch 30 -30",
                "select --map m --at 1,1,1 --out a.csv --pitch -0.5 0.5",
                "select --map m --at 1,1,1 --out a.csv --fov 1.2",
                "select --map m --at 1,1,1 --out a.csv --lattice x",
                "select --map m --at 1,1,1 --out a.csv --scale 1 --scale 2",  # an option has one value
                "plan --start 0,0",
                "map --mapping.keep_database yess",
                "map --images p --distance a b 2 --mapping.photographs.scale.marker_size_m 1",  # the scale twice
                "map --images p --scale 2",
                "view --scene a --film a.webp",
                "view --map m --path a.csv --film a.webp",
            )
        ),
    ],
)
def test_wrong_arguments_exit_with_two(arguments, capsys):
    assert main(arguments) == 2
    errors = capsys.readouterr().err
    assert errors.startswith("wheretolook: error: ") and "Traceback" not in errors


def test_the_configuration_is_printed(capsys):
    with pytest.raises(SystemExit):
        main(["scenes", "--name", "mine", "--print_config"])
    assert capsys.readouterr().out.startswith("name: mine\n")


@pytest.mark.parametrize(
    "text",
    [
        "mapping: 3\n",
        "mapping: {n_imagess: 3}\n",
        "mappin: {n_images: 3}\n",
        "camera: {width: -1}\n",
        "[1]\n",
        "a: [\n",
    ],
)
def test_an_error_in_a_file_names_the_file(text, tmp_path, capsys):
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    assert main(["map", "--config", str(path)]) == 2
    assert str(path) in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (["mapp"], "map"),
        (["map", "--n_images=3"], "--mapping.n_images"),
        (["plan", "--metod", "set"], "--method"),
        (["select", "--top", "3"], "--n"),
        (["map", "--map.n_images", "3"], "--mapping.n_images"),  # the group's former name
        (["map", "--config", str(CONFIGS / "demo.yml")], "configs/demo.yaml"),
    ],
)
def test_the_nearest_name_is_suggested(arguments, meant, capsys):
    assert main(arguments) == 2
    assert f"Did you mean {meant}?" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "gpus"), [("cuda", 0), ("cuda:3", 1)])
def test_a_missing_gpu_is_an_error_before_any_work(name, gpus, tmp_path, monkeypatch):
    monkeypatch.setattr(devices, "_driver_gpus", lambda: gpus)
    monkeypatch.setattr(devices, "_torch_gpus", lambda: gpus)
    with pytest.raises(ConfigError):
        parse_command("label", ["--data", str(tmp_path), "--device", name]).run()
    assert parse_command("label", ["--engine", "ray", "--device", name]).warp_device == name  # a cluster may have it


def test_devices(monkeypatch):
    monkeypatch.setattr(devices, "_driver_gpus", lambda: 2)
    monkeypatch.setattr(devices, "_torch_gpus", lambda: 2)
    names = ("auto", "cpu", "cuda", "cuda:1")
    assert [devices.usable_device(name) for name in names] == ["cuda", "cpu", "cuda", "cuda:1"]
    monkeypatch.setattr(devices, "_torch_gpus", lambda: 0)
    assert devices.usable_device("auto") == "cpu"
    with pytest.raises(ConfigError):
        devices.usable_device("cuda")


def test_an_interrupt_exits_with_130(monkeypatch):
    def interrupted(arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "run_command", interrupted)
    assert main(["scenes"]) == 130


@pytest.mark.parametrize("parse", ["lambda name, rest: Waiting()", "lambda name, rest: Waiting().run()"])
def test_sigterm_is_an_interrupt(parse):
    """While options are parsed and afterwards; COLMAP's own handler prints a native stack."""
    code = """
import time
from wheretolook import cli
class Waiting:
    def run(self):
        print("ready", flush=True)
        time.sleep(60)
"""
    code += f"cli.parse_command = {parse}\nraise SystemExit(cli.main(['map']))"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.terminate()
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 130
    assert errors.decode().strip().startswith("wheretolook: interrupted") and len(errors.splitlines()) == 2


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_during_an_import_is_not_swallowed(number, tmp_path):
    module = "import time\nprint('ready', flush=True)\ntry:\n    time.sleep(1)\nexcept BaseException:\n    pass\n"
    (tmp_path / "swallowing.py").write_text(module)
    code = """
import time
from wheretolook import cli
class Waiting:
    def run(self):
        import swallowing
        time.sleep(60)
cli.parse_command = lambda name, rest: Waiting()
raise SystemExit(cli.main(["map"]))
"""
    with subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(number)
        assert process.wait(timeout=30) == 130


@pytest.mark.parametrize("arguments", [["--help"], ["select", "--help"], ["evaluate", "--list-methods"]])
def test_a_closed_output_ends_a_command_silently(arguments):
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "wheretolook", *arguments]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    assert done.stderr == b"" and done.returncode in (0, 141)  # argparse ignores that its help was not read


def test_debug_shows_the_traceback(capsys):
    assert main(["scenes", "--camera.width", "0", "--debug"]) == 2
    assert "Traceback" in capsys.readouterr().err


def test_listings_hold_nothing_else(capsys):
    for name in ("demo", "release"):
        Path("data", name).mkdir(parents=True)
    assert main(["evaluate", "--list-methods"]) == 0
    assert dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()) == describe_methods()
    assert main(["figures", "--list"]) == 0
    names = [line.split("|")[1].strip() for line in capsys.readouterr().out.splitlines()]
    assert names[0] == "name" and names[2:] == [item.name for item in ITEMS]


@pytest.mark.parametrize("command", cli.command_targets())
def test_help_explains_every_option(command, capsys):
    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    missing = [name for name in cli.command_options(cli.load_command(command)) if f"--{name}" not in text]
    assert missing == [] and f"wheretolook {command} " in text


def test_usage_lists_every_command(capsys):
    assert main([]) == 0
    text = capsys.readouterr().out
    assert all(f"\n  {command} " in text for command in cli.command_targets())


HEAVY = ("torch", "warp", "scipy", "matplotlib", "mlflow", "pandas", "sklearn", "lightning", "cv2")


@pytest.mark.parametrize(
    "arguments",
    [["--help"], ["train", "--train.epoch", "10"], ["check", "--scene", "cellar"], ["view", "--scene", "cellar"]],
)
def test_help_and_early_errors_import_nothing_heavy(arguments, tmp_path):
    (tmp_path / "data" / "mine" / "hall").mkdir(parents=True)
    dataset = {"camera": {"width": 64, "height": 48, "focal_px": 32.0}, "scenes": [{"name": "hall", "split": "test"}]}
    (tmp_path / "data" / "mine" / "dataset.json").write_text(json.dumps(dataset))
    code = "import sys; from wheretolook.cli import main; main(sys.argv[2:]); "
    code += "print(*[name for name in sys.argv[1].split() if name in sys.modules], file=sys.stderr)"
    run = [sys.executable, "-c", code, " ".join(HEAVY), *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    done = subprocess.run(run, capture_output=True, text=True, check=True, cwd=tmp_path, env=environment)
    assert done.stderr.splitlines()[-1] == ""


def test_packages_import_only_what_is_below_them():
    allowed = {
        "wheretolook": {"wheretolook"},
        "wheretolook_rooms": {"wheretolook", "wheretolook_rooms"},
        "wheretolook_paper": {"wheretolook", "wheretolook_paper", "wheretolook_rooms"},
    }
    upward = []
    for package, below in allowed.items():
        for path in (ROOT / "src" / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                tops = {name.partition(".")[0] for name in names}
                upward += [f"{path}: {top}" for top in tops if top.startswith("wheretolook") and top not in below]
    assert upward == []
