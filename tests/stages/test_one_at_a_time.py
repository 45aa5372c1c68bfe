"""Two runs on one dataset: what changes it runs alone, what reads it runs beside others, and who holds it is said."""

import os

import pytest

from learning_options import train_config
from synthetic_dataset import make_dataset
from wheretolook.cli import command_options, load_command, main
from wheretolook.commands.train import train_methods
from wheretolook.dataset.config import LOCK
from wheretolook.dataset.dataset_lock import changing, reading
from wheretolook.tracking import TrackingConfig
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.errors import InUseError
from wheretolook.utils.processes import hold


@pytest.fixture
def dataset(tmp_path):
    dataset = make_dataset(tmp_path / "data" / "tiny")
    for scene in dataset.scenes:
        scene.stage_cache("label", "key").store()
    return dataset


def run(dataset, stage, *options):
    root = dataset.root
    camera = ["--camera.width", "160", "--camera.height", "120", "--camera.focal_px", "80", "--camera.fov_deg", "null"]
    where = ["--name", root.name, "--data", str(root.parent)]
    if "tracking.folder" in command_options(load_command(stage)):
        where += ["--tracking.folder", str(root.parent / "mlruns")]
    return main([stage, *where, "--device", "cpu", *camera, *options])


@pytest.mark.parametrize(
    "stage",
    ["scenes", "map", "label", "train", "evaluate", "plan", "compare-paths", "release"],
)  # fmt: skip
def test_a_stage_stops_at_once_beside_one_that_changes_the_dataset(dataset, stage, capsys):
    with changing(dataset.root, "label"):
        assert run(dataset, stage) == 2
    said = capsys.readouterr().err
    assert f"label, process {os.getpid()} on " in said


def test_a_scene_is_checked_while_another_is_mapped(dataset, capsys):
    mapped, other = dataset.scenes[:2]
    with changing(dataset.root, "map"), hold(mapped.folder / LOCK, "map"):
        for scene, said in ((mapped, f"map, process {os.getpid()}"), (other, "no COLMAP model here")):
            assert main(["check", "--scene", scene.name, "--data", str(dataset.root.parent)]) == 2
            assert said in capsys.readouterr().err


def test_training_holds_the_labels_that_it_reads(dataset, monkeypatch):
    config = train_config("mlp-2d", epochs=1, hidden=(8,), accelerator="cpu")
    tracking = TrackingConfig(str(dataset.root.parent / "mlruns"))
    save = TrainedNetwork.save

    def save_beside_others(*given):
        with pytest.raises(InUseError), changing(dataset.root, "label"):
            pass
        with pytest.raises(InUseError):
            train_methods(dataset, config, tracking, progress=False)
        with reading(dataset.root, "evaluate", "results"), reading(dataset.root, "train", "set-weights"):
            save(*given)

    monkeypatch.setattr(TrainedNetwork, "save", save_beside_others)
    (model,) = train_methods(dataset, config, tracking, progress=False)
    assert model.path.is_file()
    with changing(dataset.root, "label"):
        assert {path.name for path in dataset.root.glob(".*")} == {".lock"}
    assert not list(dataset.root.glob(".*"))


def test_files_of_killed_runs_are_removed_by_the_next_that_changes_the_dataset(dataset):
    folder = dataset.scenes[0].folder
    partial = [folder / ".map.partial" / "points3D.bin", folder / "viewpoints.parquet.partial",
               dataset.root / "weights" / "set.safetensors.partial", dataset.root / ".set-weights.lock"]  # fmt: skip
    outside = dataset.root.parent / "outside" / "half.partial"
    for path in (*partial, outside):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"half")
    (dataset.root / "link").symlink_to(outside.parent)
    before = {path for path in dataset.root.rglob("*") if path.is_file()}
    with reading(dataset.root, "evaluate", "results"):
        assert all(path.is_file() for path in partial)
    with changing(dataset.root, "map"):
        assert before - {path for path in dataset.root.rglob("*") if path.is_file()} == {*partial}
    assert outside.is_file()
