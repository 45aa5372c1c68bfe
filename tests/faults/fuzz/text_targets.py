"""Texts that a user writes: settings, waypoints, cameras, command lines; and those of the benchmark."""

from __future__ import annotations

import contextlib
import io
import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd

from faults.fuzz.execution import Target
from wheretolook.cli import _check_file, parse_experiment
from wheretolook.config import Experiment
from wheretolook.dataset.viewpoint_table import pose_columns
from wheretolook.geometry.camera import Camera, camera_of_record, read_cameras
from wheretolook.geometry.camera_text import camera_of_view, parse_camera, parse_size
from wheretolook.geometry.poses import check_poses
from wheretolook.scans.layouts import TUM, frame_files
from wheretolook.select.command import _camera, parser
from wheretolook.select.waypoints import parse_points, read_waypoints
from wheretolook.utils.options import all_options
from wheretolook.utils.reading import parse_json_object
from wheretolook.view.paths import read_paths
from wheretolook.view.state import ViewState
from wheretolook_paper.benchmark.files import read_errors, read_poses
from wheretolook_paper.benchmark.scores import Scores

_CONFIGS = Path(__file__).parents[3] / "configs"
_PARSER = parser()
_OPTIONS = all_options(Experiment)


def _settings(folder: Path) -> None:
    for name in ("demo", "paper"):
        shutil.copyfile(_CONFIGS / f"{name}.yaml", folder / f"{name}.yaml")
    (folder / "alias.yaml").write_text("name: &a b\nscenes: {train: 1, kinds: [hall]}\nmap: {n_images: 5}\n")


def _arguments(folder: Path) -> None:
    (folder / "a.txt").write_text("--name\nb\n--scenes.train=2\n--map.n_images\n5\n--camera.width=64")


def _read_arguments(text: str) -> None:
    _quietly(lambda: parse_experiment("map", text.split("\n")))


def _waypoints(folder: Path) -> None:
    (folder / "a.csv").write_text('id,x,y,z\n"a, b",1,2,1.5\nc,-0.5,2e0,1.5\n')
    (folder / "b.csv").write_text("x;y;z\n1;2;1.5\n")
    (folder / "a.tum").write_text("# t x y z\n0.5 1 2 3 0 0 0 1\n1.5 1 2 3 0 0 0 1\n")
    (folder / "a.txt").write_text("1 1 2 3\n2 -1 .2 3\n")


def _cameras(folder: Path) -> None:
    (folder / "cameras.txt").write_text(
        "# c\n1 PINHOLE 64 48 32 32 32 24\n2 OPENCV_FISHEYE 64 48 32 32 32 24 0 0 0 0\n"
    )


def _camera_texts(folder: Path) -> None:
    (folder / "pinhole").write_text("PINHOLE,640,480,320,320,320,240")
    (folder / "radial").write_text("SIMPLE_RADIAL 640 480 320 320 240 -0.1")


def _short_texts(folder: Path) -> None:
    (folder / "size").write_text("640x480")
    (folder / "points").write_text("1,2,3 -1e1,.2,3")
    (folder / "json").write_text('{"a": [1, -2.5e3, null, {"b": "c\\u00e4"}], "d": true}')


def _read_camera_file(path: Path) -> None:
    for camera in read_cameras(path).values():
        _use(camera)


def _use(camera: Camera) -> None:
    camera.project(np.array([[0.1, -0.2, 1.0], [0.0, 0.0, 0.0]]))
    assert camera_of_record(camera.record()) == camera


def _read_short_text(text: str) -> None:
    if "x" in text[:8]:
        camera_of_view(60, parse_size(text))
    elif text[:1] in ("{", "["):
        try:
            parse_json_object(text)
        except ValueError:  # what the readers of files make a typed error of
            return
    else:
        parse_points(text.split(" "))


def _command(folder: Path) -> None:
    text = "--map\nm\n--at\n1,2,1.5\n-1,2,1.5\n--out\na.csv\n--n\n2\n--pitch\n-30\n30\n--fov\n60\n--size\n64x48"
    (folder / "a.txt").write_text(text)


def _read_command(text: str) -> None:
    words = text.split("\n")
    given = [f" {word}" if re.match(r"-[\d.]", word) else word for word in words]
    _quietly(lambda: _camera(_PARSER.parse_args(given)))


def _quietly(work) -> None:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        work()


def _benchmark(folder: Path) -> None:
    poses = "".join(f"{name} 1 0 0 0 {name} 2 3\n" for name in (1, 2, 10))
    (folder / "poses.txt").write_text("# id qw qx qy qz tx ty tz\n" + poses)
    (folder / "errors.txt").write_text("1.png 0.01 0.2\n10 0.5 nan\n2.png nan nan\n")


def _read_benchmark(path: Path) -> None:
    poses = read_poses(path.with_name("poses.txt"))
    assert np.isfinite(poses.cam_from_world).all()
    Scores.of(poses, read_errors(path.with_name("errors.txt")))


def _paths(folder: Path) -> None:
    cam_from_world = np.tile(np.eye(3, 4), (3, 1, 1))
    about = {"method": "set", "pair": 0, "task": "planned", "waypoint": range(3)}
    table = pd.DataFrame({**about, **pose_columns(cam_from_world), "status": "localized", "error_m": 0.1})
    table.assign(error_deg=0.1).to_parquet(folder / "views.parquet")
    table.to_csv(folder / "path.csv", index=False)
    (folder / "views.csv").write_text("x,y,z,qw,qx,qy,qz\n1,2,3,1,0,0,0\n2,2,3,0,1,0,0\n")
    (folder / "a.tum").write_text("# t x y z\n0.5 1 2 3 0 0 0 1\n1.5 1 2 3 0 0 0 1\n")


def _read_path(path: Path) -> None:
    for played in read_paths(path).values():
        check_poses(played.cam_from_world)


def _recording(folder: Path) -> None:
    (folder / "rgb.txt").write_text("# t name\n1.0 a.png\n2.0 a.png\n")
    (folder / "depth.txt").write_text("1.01 a.png\n2.01 a.png\n")
    (folder / "groundtruth.txt").write_text("1.0 1 2 3 0 0 0 1\n2.0 1 2 3 0 1 0 0\n")
    (folder / "a.png").write_text("")


def _read_recording(path: Path) -> None:
    frames, _ = frame_files(path.parent, TUM)
    check_poses(np.stack([frame.cam_from_world for frame in frames]))


def _states(folder: Path) -> None:
    (folder / "state").write_text("method=set;n=3;height=1.4;place=1,2,1.5;yaw=-30;eye=0,0,9")
    (folder / "link").write_text("/?view=n=3;threshold=0.25;occlusion=none;cut=2")


def _read_state(text: str) -> None:
    state = ViewState.of_path(text) if text.startswith("/") else ViewState.parse(text)
    assert state is None or ViewState.parse(state.text()) is not None


TARGETS = (
    Target("yaml", _settings, ("demo.yaml", "paper.yaml", "alias.yaml"), lambda path: _check_file(path, _OPTIONS)),
    Target("settings", _settings, ("alias.yaml",), lambda path: parse_experiment("map", ["--config", str(path)])),
    Target("arguments", _arguments, ("a.txt",), _read_arguments, in_memory=True),
    Target("waypoints", _waypoints, ("a.csv", "b.csv", "a.tum", "a.txt"), read_waypoints),
    Target("cameras", _cameras, ("cameras.txt",), _read_camera_file),
    Target("camera-texts", _camera_texts, ("pinhole", "radial"), lambda text: _use(parse_camera(text)), in_memory=True),
    Target("short-texts", _short_texts, ("size", "points", "json"), _read_short_text, in_memory=True),
    Target("select", _command, ("a.txt",), _read_command, in_memory=True),
    Target("paths", _paths, ("views.parquet", "path.csv", "views.csv", "a.tum"), _read_path),
    Target("recordings", _recording, ("rgb.txt", "depth.txt", "groundtruth.txt"), _read_recording),
    Target("states", _states, ("state", "link"), _read_state, in_memory=True),
    Target("benchmark", _benchmark, ("poses.txt", "errors.txt"), _read_benchmark),
)
