"""Two runs on one dataset: what changes it runs alone, what reads it runs beside others, and who holds it is said."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from learning_options import train_config
from synthetic_dataset import make_dataset
from wheretolook.cli import load_command, main, option_types
from wheretolook.commands.train import train_methods
from wheretolook.dataset.dataset_lock import changing, reading
from wheretolook.dataset.layout import Dataset
from wheretolook.tracking.config import TrackingConfig
from wheretolook.utils.errors import InUseError

HOLDER = """
import sys
from pathlib import Path
from wheretolook.dataset.dataset_lock import changing
with changing(Path(sys.argv[1]), "label"):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    dataset = make_dataset(tmp_path / "data" / "tiny")
    for scene in dataset.scenes:
        scene.stage_cache("label", "key").store()
    return dataset


def run(dataset: Dataset, stage: str, *options: str) -> int:
    root = dataset.root
    camera = ["--camera.width", "160", "--camera.height", "120", "--camera.focal_px", "80", "--camera.fov_deg", "null"]
    where = ["--name", root.name, "--data", str(root.parent)]
    if "tracking.folder" in option_types(load_command(stage)):
        where += ["--tracking.folder", str(root.parent / "mlruns")]
    return main([stage, *where, "--device", "cpu", *camera, *options])


@pytest.mark.parametrize(
    "stage",
    ["scenes", "map", "sample", "label", "train", "evaluate", "viewpoint-map", "plan", "compare-paths", "release",
     "figures", "log-release", "demo"],
)  # fmt: skip
def test_a_stage_stops_at_once_beside_one_that_changes_the_dataset(
    dataset: Dataset, stage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with changing(dataset.root, "label"):
        assert run(dataset, stage) == 2
    said = capsys.readouterr().err
    assert f"label, process {os.getpid()} on " in said


def test_what_a_killed_run_held_is_free(dataset: Dataset, capsys: pytest.CaptureFixture[str]) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    arguments = [sys.executable, "-c", HOLDER, str(dataset.root)]
    other = subprocess.Popen(arguments, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert other.stdout is not None and other.stdout.readline() == "held\n"
    assert run(dataset, "sample") == 2
    assert f"label, process {other.pid} on " in capsys.readouterr().err
    other.send_signal(signal.SIGKILL)
    other.wait()
    assert run(dataset, "sample") == 2
    assert "`wheretolook map`" in capsys.readouterr().err  # it reads the dataset now


def test_training_holds_the_labels_that_it_learns_from(dataset: Dataset) -> None:
    config = train_config("mlp-2d", epochs=40, hidden=(32,), accelerator="cpu")
    tracking = TrackingConfig(str(dataset.root.parent / "mlruns"))
    failed: list[BaseException] = []

    def train() -> None:
        try:
            train_methods(dataset, config, tracking, progress=False)
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=train)
    thread.start()
    while not (dataset.root / ".mlp-2d-weights.lock").is_file():
        assert thread.is_alive(), failed
        time.sleep(0.001)
    with pytest.raises(InUseError, match="train, process"), changing(dataset.root, "label"):
        pass
    with pytest.raises(InUseError, match="train, process"):
        train_methods(dataset, config, tracking, progress=False)
    with reading(dataset.root, "evaluate", "results"), reading(dataset.root, "train", "set-weights"):
        pass
    thread.join()
    assert not failed
    with changing(dataset.root, "label"):
        assert {path.name for path in dataset.root.glob(".*")} == {".lock"}
    assert not list(dataset.root.glob(".*"))


def test_what_killed_runs_left_is_removed_by_the_next_that_changes_the_dataset(dataset: Dataset) -> None:
    scene = dataset.scenes[0]
    left = [scene.folder / ".map.partial" / "points3D.bin", scene.table.with_name("viewpoints.parquet.partial"),
            scene.folder / "photographs" / "tmpabc.partial" / "database.db",
            dataset.root / "weights" / "set.safetensors.partial", dataset.root / ".set-weights.lock"]  # fmt: skip
    for path in left:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"half")
    elsewhere = dataset.root.parent / "elsewhere" / "half.partial"
    elsewhere.parent.mkdir()
    elsewhere.write_bytes(b"not ours")
    (dataset.root / "link").symlink_to(elsewhere.parent)
    before = {path for path in dataset.root.rglob("*") if path.is_file()}
    with reading(dataset.root, "evaluate", "results"):
        assert all(path.is_file() for path in left)
    with changing(dataset.root, "map"):
        assert before - {path for path in dataset.root.rglob("*") if path.is_file()} == {*left}
    assert not left[0].parent.exists() and elsewhere.is_file()
