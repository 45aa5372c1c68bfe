"""The sub-command that makes viewpoint maps."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from box_scenes import ROOM, furnished_room
from planning.rooms import CAMERA, build, occlusion, room_landmarks, room_map
from wheretolook.cli import main
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.planning.map_building import build_viewpoint_map
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.scenes.loading import save_glb
from wheretolook.scorers.registry import make_scorer
from wheretolook.utils.files import write_json
from wheretolook.utils.shipped import WEIGHTS, shipped
from wheretolook.weights.resolve import resolve_weights

LANDMARKS = room_landmarks(200)
ACTLOC = Path(__file__).parents[2] / "data" / "release" / "weights"


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """Two scenes as the map stage leaves them, and a configuration."""
    scenes = tuple(SceneFolder(tmp_path / "data" / "rooms" / name, "test", CAMERA) for name in ("a", "b"))
    for scene in scenes:
        scene.map.mkdir(parents=True)
        save_glb(furnished_room(), scene.mesh)
        LANDMARKS.save(scene.landmarks)
        write_json(scene.folder / "stages.json", {"scenes": "x", "map": "y"})
    Dataset(tmp_path / "data" / "rooms", scenes).save()
    (tmp_path / "rooms.yaml").write_text(
        "name: rooms\ncamera: {width: 160, height: 120, focal_px: 80}\nviewpoint_map: {grid: [5, 4, 3], directions: 60}"
    )
    return tmp_path


def run(folder: Path, *options: str) -> int:
    return main(["viewpoint-map", "--config", str(folder / "rooms.yaml"), "--data", str(folder / "data"),
                 "--device", "cpu", *options])  # fmt: skip


def test_a_scenes_map_is_that_of_its_scorer(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = dataset / "a.map"
    assert run(dataset, "--scene", "a", "--method", "bins", "--out", str(out)) == 0
    assert "60 directions at" in capsys.readouterr().out
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


def test_the_papers_network_scores_for_its_field_of_view_alone(dataset: Path) -> None:
    weights = dataset / "data" / "release" / "weights"
    weights.mkdir(parents=True)
    for suffix in ("safetensors", "json"):
        shutil.copy(ACTLOC / f"mlp-2d+z.{suffix}", weights)
    rooms = Dataset.load(dataset / "data" / "rooms")
    assert resolve_weights(dataset=rooms) == weights / "mlp-2d+z.safetensors"
    narrow = tuple(replace(scene, camera=replace(CAMERA, focal_px=70.0)) for scene in rooms.scenes)
    assert resolve_weights(dataset=replace(rooms, scenes=narrow)) == shipped(WEIGHTS) / "set.safetensors"
    assert resolve_weights("mlp-2d+z", dataset=replace(rooms, scenes=narrow)) is None


def test_without_any_weights_those_that_ship_score(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(dataset, "--scene", "a") == 0
    assert f"scored by {shipped(WEIGHTS) / 'set.safetensors'}" in capsys.readouterr().out
    named = ("--weights", f"{WEIGHTS}/mlp-2d+z.safetensors")
    assert run(dataset, "--scene", "a", *named) == 0
    assert "scored by mlp-2d+z" in capsys.readouterr().out


def test_the_best_weights_there_are_score(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights = dataset / "data" / "release" / "weights"
    weights.mkdir(parents=True)
    for suffix in ("safetensors", "json"):
        shutil.copy(ACTLOC / f"set.{suffix}", weights)
    assert run(dataset, "--scene", "a") == 0
    assert "release/weights/set.safetensors" in capsys.readouterr().out
    folder = dataset / "data" / "rooms" / "a" / "viewpoint-map"
    assert ViewpointMap.load(folder).origin.scorer == "set"
    assert run(dataset, "--scene", "a", "--method", "bins") == 0
    assert ViewpointMap.load(folder).origin.scorer == "bins"
    rooms = Dataset.load(dataset / "data" / "rooms")
    assert resolve_weights(dataset=rooms) == weights / "set.safetensors"
    narrow = tuple(replace(scene, camera=replace(CAMERA, focal_px=70.0)) for scene in rooms.scenes)
    assert (
        resolve_weights(dataset=replace(rooms, scenes=narrow)) == weights / "set.safetensors"
    )  # it serves every camera
    own = dataset / "data" / "rooms" / "weights"
    shutil.copytree(weights, own)  # learnt from other scenes than those of the dataset
    shutil.copy(weights / "set.safetensors", own / "trees.safetensors")  # without a record
    (own / "conv.safetensors").write_bytes(b"damaged")
    said: list[str] = []
    assert resolve_weights(dataset=rooms, log=said.append) == weights / "set.safetensors"
    assert [text.split(":")[1].split("/")[-1] for text in said] == [
        "conv.safetensors", "set.safetensors", "trees.safetensors",
    ]  # fmt: skip
    assert "other data" in said[1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--scene", "c"], "There are a, b"),
        (["--out", "x"], "Name a scene"),
        (["--scene", "a", "--method", "mlp"], "needs weights"),
        (["--scene", "a", "--weights", "none.safetensors"], "none.safetensors"),
        (["--scene", "a", "--viewpoint_map.grid", "[1, 1, 1]", "--scenes.free_space.clearance_m", "3"], "mesh.glb"),
    ],
)
def test_bad_input_is_named(
    dataset: Path, options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(dataset, *options) == 2
    errors = capsys.readouterr().err
    assert message in errors and "Traceback" not in errors
