"""The sub-command that makes viewpoint maps."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from box_scenes import ROOM
from planning.rooms import CAMERA, build, occlusion, room_landmarks, room_map, write_room_dataset
from wheretolook.cli import main
from wheretolook.dataset.layout import Dataset
from wheretolook.planning.scene_map import build_viewpoint_map
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.scorers.registry import make_scorer
from wheretolook.scorers.weights import resolve_weights
from wheretolook.utils.package import WEIGHTS, shipped

LANDMARKS = room_landmarks(200)
RELEASED = Path(__file__).parents[2] / "data" / "release" / "weights"


@pytest.fixture
def dataset(tmp_path):
    """Two scenes as the map stage leaves them, and a configuration."""
    write_room_dataset(tmp_path, LANDMARKS, names="ab")
    (tmp_path / "rooms.yaml").write_text(
        "name: rooms\ncamera: {width: 160, height: 120, focal_px: 80}\nviewpoint_map: {grid: [5, 4, 3], directions: 60}"
    )
    return tmp_path


def run(folder, *options):
    return main(["viewpoint-map", "--config", str(folder / "rooms.yaml"), "--data", str(folder / "data"),
                 "--device", "cpu", *options])  # fmt: skip


def test_a_scenes_map_is_that_of_its_scorer(dataset):
    out = dataset / "a.map"
    assert run(dataset, "--scene", "a", "--method", "bins", "--out", str(out)) == 0
    found = ViewpointMap.load(out)
    expected = build(LANDMARKS)
    np.testing.assert_allclose([found.grid.lower, found.grid.upper], [(0, 0, 0), ROOM], atol=1e-6)
    np.testing.assert_array_equal(found.row_of_voxel, expected.row_of_voxel)
    again = build_viewpoint_map(
        make_scorer("bins", room_map(LANDMARKS, occlusion())), found.grid, found.voxel_of_row, found.directions
    )
    np.testing.assert_array_equal(found.scores, again.scores)
    np.testing.assert_array_equal(found.n_visible, again.n_visible)
    assert not (dataset / "data" / "rooms" / "b" / "viewpoint-map").exists()


@pytest.mark.parametrize("method", ["mlp-2d+z", "set"])
def test_weights_resolve_to_those_that_fit_the_camera(dataset, method):
    rooms = Dataset.load(dataset / "data" / "rooms")
    assert resolve_weights(dataset=rooms) == shipped(WEIGHTS) / "set.safetensors"
    weights = dataset / "data" / "release" / "weights"
    weights.mkdir(parents=True)
    for suffix in ("safetensors", "json"):
        shutil.copy(RELEASED / f"{method}.{suffix}", weights)
    file = weights / f"{method}.safetensors"
    assert resolve_weights(dataset=rooms) == file
    narrow = tuple(replace(scene, camera=replace(CAMERA, focal_px=70.0)) for scene in rooms.scenes)
    any_camera = file if method == "set" else shipped(WEIGHTS) / "set.safetensors"
    assert resolve_weights(dataset=replace(rooms, scenes=narrow)) == any_camera
    own = dataset / "data" / "rooms" / "weights"
    shutil.copytree(weights, own)  # trained on other scenes than those of the dataset
    shutil.copy(file, own / "trees.safetensors")  # without a record
    (own / "conv.safetensors").write_bytes(b"damaged")
    assert resolve_weights(dataset=rooms) == file


def test_the_resolved_weights_score_a_map(dataset):
    folder = dataset / "data" / "rooms" / "a" / "viewpoint-map"
    for options, scorer in (((), "set"), (("--weights", f"{WEIGHTS}/mlp-2d+z.safetensors"), "mlp-2d+z")):
        assert run(dataset, "--scene", "a", *options) == 0
        assert ViewpointMap.load(folder).origin.scorer == scorer


@pytest.mark.parametrize(
    "options",
    [
        ["--scene", "c"],
        ["--out", "x"],
        ["--scene", "a", "--method", "mlp"],
        ["--scene", "a", "--weights", "none.safetensors"],
        ["--scene", "a", "--viewpoint_map.grid", "[1, 1, 1]", "--scenes.free_space.clearance_m", "3"],
    ],
)
def test_invalid_input(dataset, options):
    assert run(dataset, *options) == 2
