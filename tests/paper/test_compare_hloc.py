"""The comparison with hloc, from a mesh to the table; with hloc where it is installed."""

from importlib.util import find_spec

import numpy as np
import pytest

from box_scenes import furnished_room
from wheretolook.mapping.colmap_model import colmap_poses, read_model, registered_names
from wheretolook.scenes.loading import save_glb
from wheretolook.utils.errors import ConfigError
from wheretolook_paper.studies.compare_hloc import main, render_set, summarize


@pytest.mark.slow
def test_a_mesh_becomes_a_set_and_its_queries_localize(tmp_path, capsys):
    mesh = tmp_path / "room.glb"
    save_glb(furnished_room(), mesh)
    sizes = {"locations": 2, "images": 16, "work": tmp_path / "work"}
    table = main([str(mesh)], tmp_path / "poses.csv", partners=8, retrieved=4, **sizes)

    folder = render_set(str(mesh), **sizes)  # made before
    queries = dict(line.split() for line in (folder / "queries.txt").read_text().splitlines())
    model = read_model(folder)
    assert len(model.points3D) == 0
    names = [*registered_names(model).values()]
    assert len(names) == 16 + len(queries) and {*queries} < {*names}
    assert {path.name for path in (folder / "images").iterdir()} == {*names}
    assert np.isfinite(colmap_poses(folder, model)).all()

    has_hloc = find_spec("hloc") is not None
    assert {*table["method"]} == {"first", "hypotheses"} | ({"hloc"} if has_hloc else set())
    assert ("hloc is not installed" in capsys.readouterr().out) == (not has_hloc)
    for _, poses in table.groupby("method"):
        assert {*poses["query"]} == {*queries}
    recall = summarize(table).set_index(["method", "accuracy"])["recall"]
    assert recall["hypotheses", "25 cm, 2 deg"] > 0.5

    again = main([str(folder)], tmp_path / "again.csv", work=sizes["work"])
    assert np.array_equal(again["error_m"], table["error_m"], equal_nan=True)


def test_neither_folder_nor_mesh_nor_scene(tmp_path):
    for name in ("nowhere.glb", "castle-3", "building-x", "building"):
        with pytest.raises(ConfigError, match="no such set") as error:
            render_set(name, 1, 10, tmp_path)
        assert error.value.value == name
        assert "building-700" in str(error.value)
