"""Names from files and options stay within the folder that they are names in."""

from pathlib import Path

import pytest

from wheretolook.cli import main
from wheretolook.config import Experiment
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.training.scenes import with_also
from wheretolook.utils.confine import check_links, entry_of, path_within
from wheretolook.utils.errors import ConfigError, TableError, WhereToLookError
from wheretolook.utils.files import write_json
from wheretolook_paper.benchmark.folder import BenchmarkScene

OUTSIDE = ["../victim", "../../victim", "/victim", "a/../../victim", "..", ".", "", "a/b", "a\0b"]


@pytest.mark.parametrize("name", [*OUTSIDE, 5, None, ["a"]])
def test_a_name_is_one_entry_of_its_folder(name: object, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="lead out"):
        entry_of(tmp_path, name, "a name")
    assert entry_of(tmp_path, "my scene.1", "a name") == tmp_path / "my scene.1"


@pytest.mark.parametrize("name", ["../1.jpg", "a/../../1.jpg", "/1.jpg", "", "1\0.jpg"])
def test_a_path_within_a_folder_does_not_go_up(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="lead out"):
        path_within(tmp_path, name, "a photograph's name")
    assert path_within(tmp_path, "left/1.jpg", "a photograph's name") == tmp_path / "left" / "1.jpg"


@pytest.mark.parametrize("name", [name for name in OUTSIDE if "\0" not in name])
def test_a_scene_of_a_dataset_lies_in_its_folder(name: str, tmp_path: Path) -> None:
    root = tmp_path / "data" / "set"
    scene = {"name": name, "split": "train"}
    write_json(root / "dataset.json", {"camera": PinholeCamera().record(), "scenes": [scene]})
    with pytest.raises(TableError, match=r"dataset\.json.*lead out"):
        Dataset.load(root)


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("option", ["name", "release_name"])
def test_datasets_and_releases_lie_in_the_data_folder(option: str, name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="folder"):
        Experiment(data=tmp_path, **{option: name})


def test_datasets_learnt_from_as_well_lie_beside_the_dataset(tmp_path: Path) -> None:
    scene = SceneFolder(tmp_path / "data" / "set" / "room", "train")
    scene.folder.mkdir(parents=True)
    with pytest.raises(ConfigError, match="lead out"):
        with_also(Dataset(scene.folder.parent, (scene,)), ["../../victim"])


@pytest.mark.parametrize(
    "place", ["room", "results", "room/shards", "room/map/landmarks.npz", "room/viewpoints.parquet"]
)
def test_links_that_lead_out_of_a_dataset_are_refused(place: str, tmp_path: Path) -> None:
    root = tmp_path / "data" / "set"
    (root / "room" / "map").mkdir(parents=True)
    Dataset(root, (SceneFolder(root / "room", "train"),)).save()
    assert [scene.name for scene in Dataset.load(root).scenes] == ["room"]
    (tmp_path / "victim").mkdir()
    path = root / place
    if place == "room":
        (root / "room" / "map").rmdir()
        path.rmdir()
    path.symlink_to(tmp_path / "victim")
    with pytest.raises(WhereToLookError, match=rf"{path.name}: this link leads out") as caught:
        Dataset.load(root)
    assert str(path) in str(caught.value)


def test_a_dataset_may_lie_behind_a_link_that_is_named_as_its_folder_and_hold_links_within(tmp_path: Path) -> None:
    (tmp_path / "disk" / "set" / "room").mkdir(parents=True)
    (tmp_path / "data").symlink_to(tmp_path / "disk")
    root = Experiment(name="set", data=tmp_path / "data").root
    Dataset(root, (SceneFolder(root / "room", "train"),)).save()
    (root / "room" / "again.json").symlink_to(root / "dataset.json")
    assert Dataset.load(root).scenes[0].folder == root / "room"
    (tmp_path / "disk" / "other").symlink_to(tmp_path)
    with pytest.raises(ConfigError, match="this link leads out"):
        Experiment(name="other", data=tmp_path / "data")


def test_a_link_to_itself_is_refused(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(ConfigError, match="this link leads out"):
        check_links(tmp_path, depth=1)


def test_images_of_a_benchmark_are_read_from_its_folder_alone(tmp_path: Path) -> None:
    images = tmp_path / "scene" / "scene_reconstruction" / "images"
    images.mkdir(parents=True)
    scene = BenchmarkScene("scene", images.parent, images, tmp_path / "mesh.glb", tmp_path / "waypoints.txt")
    for path in (images / "0.png", tmp_path / "0.png"):
        path.write_bytes(b"")
    for name in ("0.png", "scene_reconstruction/images/0.png", str(tmp_path / "0.png"), "../../../0.png"):
        assert scene.image_file(name).resolve() == images / "0.png"


@pytest.mark.parametrize("name", [name for name in OUTSIDE if "\0" not in name])
@pytest.mark.parametrize("command", ["check", "view"])
def test_the_scene_of_a_command_lies_in_its_dataset(
    command: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "data" / "set"
    write_json(root / "dataset.json", {"camera": PinholeCamera().record(), "scenes": []})
    (tmp_path / "victim").mkdir()
    before = sorted(tmp_path.rglob("*"))
    port = ["--port", "0"] if command == "view" else []
    for named in (["--scene", name], ["--scene", "room", "--name", name]):
        if named[-1] or len(named) == 2:  # an empty --name stands for none
            assert main([command, *named, "--data", str(tmp_path / "data"), *port]) == 2
            assert "lead out of its folder" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before
