"""Outputs are regular files or folders, and never inputs; names and permissions are reported as what they are."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from disks import read_only, small_disk
from wheretolook.cli import main
from wheretolook.commands import scenes
from wheretolook.commands.export import Export
from wheretolook.commands.plan import Plan
from wheretolook.commands.select import Select
from wheretolook.commands.view import View
from wheretolook.commands.viewpoint_map import BuildViewpointMap
from wheretolook.dataset.dataset_lock import changing
from wheretolook.planning.config import PlanConfig
from wheretolook.select.waypoints import read_waypoints
from wheretolook.utils.errors import ConfigError, MapError, StorageError, TableError
from wheretolook.utils.files import check_folder_name, check_output, read_text, write_text


def _fifo(folder):
    os.mkfifo(folder / "fifo")
    return folder / "fifo"


def _link(folder):
    (folder / "real").write_text("kept")
    (folder / "link").symlink_to("real")
    return folder / "link"


def _loop(folder):
    (folder / "loop").symlink_to("loop")
    return folder / "loop"


def _in_dataset(folder):
    (folder / "dataset.json").touch()
    return folder / "room" / "map" / "views.csv"


@pytest.mark.parametrize(
    "make",
    [_fifo, _link, _loop, _in_dataset, lambda _: Path("/dev/null"), lambda f: f / "in", lambda f: f / "in/images.txt"],
)
def test_outputs_that_would_destroy_something(make, tmp_path):
    with pytest.raises(ConfigError):
        check_output(make(tmp_path), [tmp_path / "in"])


def test_usual_outputs(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "linked").symlink_to("real")
    for name in ("new.csv", "real", "linked", "in/views.csv"):
        check_output(tmp_path / name, [tmp_path / "in"])


def test_commands_check_their_outputs(tmp_path, capsys):
    waypoints = tmp_path / "at.csv"
    waypoints.write_text("1,2,3\n")
    assert main(["select", "--map", str(tmp_path), "--at", str(waypoints), "--out", str(waypoints)]) == 2
    assert main(["export", "--map", str(tmp_path), "--out", str(tmp_path)]) == 2
    settings = tmp_path / "settings.yaml"
    settings.write_text(f"plan:\n  out: {waypoints}\n")
    files = ["--config", str(settings), "--plan.weights", str(waypoints), "--data", str(tmp_path)]
    assert main(["plan", *files, "--start", "0,0,0", "--goal", "1,1,1"]) == 2
    assert capsys.readouterr().err.count("an output is") == 3
    for command in (
        Select(map=tmp_path, at=(str(waypoints),), out=waypoints),
        Select(map=tmp_path, at=("1,2,3",), out=tmp_path / "a.png", floor_plan=tmp_path / "a.png", format="csv"),
        View(map=tmp_path, record=_fifo(tmp_path).rename(tmp_path / "fifo.rrd")),
    ):
        with pytest.raises(ConfigError, match="an output is"):
            command.run()
    for command in (
        Export(map=tmp_path / "model", out=tmp_path),
        Plan(data=tmp_path / "data", plan=PlanConfig(out=tmp_path)),
        BuildViewpointMap(data=tmp_path / "data", out=waypoints),
    ):
        with pytest.raises(ConfigError, match="this holds something else"):
            command.run()
    for out in ("/", str(tmp_path), str(waypoints / "a")):
        assert main(["select", "--map", str(tmp_path / "model"), "--at", "1,2,3", "--out", out]) == 2
    with pytest.raises(ConfigError, match="an output is"):
        write_text(tmp_path / "fifo.rrd", "")
    assert waypoints.read_text() == "1,2,3\n"


@pytest.mark.parametrize("command", ["map", "check", "adapt"])
def test_a_failed_import_leaves_no_folders(command, tmp_path):
    for name in ("cameras", "images", "points3D"):
        (tmp_path / f"{name}.txt").write_text("no model\n")
    data = tmp_path / "data"
    option = "--model" if command == "map" else "--map"
    tracking = ["--tracking.folder", str(tmp_path / "mlruns")] if command == "adapt" else []
    assert main([command, option, str(tmp_path), "--data", str(data), *tracking]) == 2
    assert not data.exists()


def test_scene_names():
    for name in ("Büro 2. Stock", "Bu\u0308ro", "room-1"):
        check_folder_name("a name", name)
    for name in ("", " a", "a ", ".a", "a/b", "a\n", "a*"):
        with pytest.raises(ConfigError):
            check_folder_name("a name", name)


def test_waypoints_from_pipes_and_with_byte_order_marks(tmp_path):
    reading, writing = os.pipe()
    os.write(writing, b"x,y,z\n1,2,3\n")
    os.close(writing)
    assert read_waypoints(f"/dev/fd/{reading}").points.tolist() == [[1, 2, 3]]
    os.close(reading)
    with pytest.raises(TableError):  # of which no shell holds the other end
        read_waypoints(_fifo(tmp_path))
    (tmp_path / "bom.csv").write_bytes(b"\xef\xbb\xbfx,y,z\n1,2,3\n")
    assert read_waypoints(tmp_path / "bom.csv").points.tolist() == [[1, 2, 3]]
    assert read_text(tmp_path / "bom.csv").startswith("x")


def test_permission_denied_is_not_damage():
    try:
        try:
            raise ValueError("unreadable") from PermissionError(13, "Permission denied", "a.npz")
        except ValueError as error:
            raise MapError("damaged", path="a.npz", fix="Remove it.") from error
    except MapError as error:
        assert str(error).startswith("a.npz: Permission denied")
        assert "Remove" not in str(error)


def test_links_of_the_user_are_kept(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "a.partial").touch()
    deep = tmp_path / "set" / "room" / "map"
    deep.mkdir(parents=True)
    (deep / "broken").symlink_to("nowhere")
    (tmp_path / "set" / "linked").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "release").symlink_to("set")
    with changing(tmp_path / "release", "label"):
        pass
    assert (deep / "broken").is_symlink()
    assert (tmp_path / "elsewhere" / "a.partial").exists()


START_WARP = "from wheretolook.utils.warp import start_warp; start_warp()"


def _started_warp(home):
    environment = {k: v for k, v in os.environ.items() if k not in ("WARP_CACHE_PATH", "XDG_CACHE_HOME")}
    run = [sys.executable, "-c", START_WARP]
    return subprocess.run(run, env=environment | {"HOME": home}, capture_output=True, text=True)


def test_an_unwritable_home_names_the_variable_to_set(tmp_path):
    done = _started_warp("/dev/null/x")
    assert "ConfigError" in done.stderr and "WARP_CACHE_PATH" in done.stderr
    with small_disk(tmp_path / "disk", 8 * 2**20) as disk:
        assert _started_warp(str(disk)).returncode == 0
        with read_only(disk):
            done = _started_warp(str(disk))
    assert "ConfigError" in done.stderr and "WARP_CACHE_PATH" in done.stderr


def test_a_read_only_folder_is_found_before_scenes_are_made(tmp_path, monkeypatch):
    def no_work(*arguments):
        raise AssertionError("a scene is made that cannot be written")

    monkeypatch.setattr(scenes, "save_scene", no_work)
    with small_disk(tmp_path / "disk", 8 * 2**20) as disk, read_only(disk), pytest.raises(StorageError) as raised:
        scenes.Scenes(data=disk).run()
    assert raised.value.path == disk / "demo" and raised.value.fix
