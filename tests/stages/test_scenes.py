"""The scenes stage on a mesh of its user's: descriptions of datasets that cannot be read."""

import pytest

from box_scenes import furnished_room
from wheretolook.commands.options import MeshSource, ScenesConfig
from wheretolook.commands.scenes import Scenes
from wheretolook.dataset.layout import Dataset
from wheretolook.scenes.loading import save_glb
from wheretolook.utils.errors import TableError


def test_a_description_of_another_version_is_replaced(tmp_path):
    save_glb(furnished_room(), tmp_path / "room.glb")
    config = ScenesConfig(train=0, test=0, meshes=(MeshSource(tmp_path / "room.glb"),))
    stage = Scenes(name="mine", data=tmp_path, device="cpu", scenes=config)
    made = stage.run()
    (made.root / "dataset.json").write_text('{"scenes": ["room"]}')
    with pytest.raises(TableError, match="Run the scenes stage"):
        Dataset.load(made.root)
    logged = []
    assert stage.run(log=logged.append) == made == Dataset.load(made.root)
    assert len(logged) == 1 and "reusing" in logged[0]
