"""Names from files and options stay within the folder that they are names in."""

import pytest

from wheretolook.commands.options import Experiment
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.training.scenes import with_also
from wheretolook.utils.errors import ConfigError, TableError
from wheretolook.utils.files import path_within, safe_child, write_json

OUTSIDE = ["../victim", "/victim", "a/../../victim", "..", ".", "", "a/b", "a\0b"]


@pytest.mark.parametrize("name", [*OUTSIDE, 5, None])
def test_a_name_is_one_entry_of_its_folder(name, tmp_path):
    with pytest.raises(ConfigError):
        safe_child(tmp_path, name, "a name")
    assert safe_child(tmp_path, "my scene.1", "a name") == tmp_path / "my scene.1"


@pytest.mark.parametrize("name", ["../1.jpg", "a/../../1.jpg", "/1.jpg", "", "1\0.jpg"])
def test_a_path_within_a_folder_does_not_go_up(name, tmp_path):
    with pytest.raises(ConfigError):
        path_within(tmp_path, name, "a photograph's name")
    assert path_within(tmp_path, "left/1.jpg", "a photograph's name") == tmp_path / "left" / "1.jpg"


@pytest.mark.parametrize("name", ["../victim", "/victim"])
def test_datasets_scenes_and_releases_are_in_their_folders(name, tmp_path):
    root = tmp_path / "data" / "set"
    write_json(root / "dataset.json", {"camera": PinholeCamera().record(), "scenes": [{"name": name, "split": "test"}]})
    with pytest.raises(TableError):
        Dataset.load(root)
    with pytest.raises(ConfigError):
        Experiment(data=tmp_path, name=name)
    with pytest.raises(ConfigError):
        with_also(Dataset(root, (SceneFolder(root / "room", "train"),)), [name])


@pytest.mark.parametrize(
    "text", ["", "[1]", "{}", '{"mapped_floor": 3}', '{"mapped_floor": [[1, 2]]}', '{"mapped_floor": ["abcd"]}']
)
def test_a_damaged_description_of_a_scene_is_reported(text, tmp_path):
    (tmp_path / "scene.json").write_text(text)
    with pytest.raises(TableError):
        SceneFolder(tmp_path, "test").mapped_floor()
