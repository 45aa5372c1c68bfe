"""Paths of a scene by the plan and viewpoint-map stages, seen by a pinhole and by a fisheye."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from box_scenes import furnished_room
from planning.rooms import occlusion, patiently, room_landmarks
from wheretolook.cli import parse_command
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.viewpoint_table import poses
from wheretolook.geometry.camera import Camera, ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.planning.routes import PlannedPath
from wheretolook.planning.viewpoint_map import ViewpointMap
from wheretolook.scenes.loading import save_glb
from wheretolook.scorers.base import Scorer
from wheretolook.scorers.registry import make_scorer
from wheretolook.utils.files import write_json

LANDMARKS = room_landmarks(300)
WEIGHTS = Path(__file__).parents[2] / "data" / "release" / "weights" / "set.safetensors"
OFF_CENTER = PinholeCamera(160, 120, 80.0, 85.0, (74.0, 65.0))
FISHEYE = ColmapCamera("OPENCV_FISHEYE", 160, 120, (55.0, 55.0, 80.0, 60.0, 0.01, -0.002, 0.0, 0.0))
START = (1.0, 1.0, 1.4)
GOAL = (2.8, 1.6, 1.4)


@pytest.fixture(autouse=True)
def untracked(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new tracking store takes seconds to make."""
    monkeypatch.setattr(import_module("wheretolook.commands.plan"), "_log", lambda *given: None)


def options(folder: Path, camera: Camera) -> list[str]:
    """A dataset of one room as the map stage leaves it, and the options that ask for it."""
    scene = SceneFolder(folder / "data" / "rooms" / "room", "test", camera)
    scene.map.mkdir(parents=True)
    save_glb(furnished_room(), scene.mesh)
    LANDMARKS.save(scene.landmarks)
    write_json(scene.folder / "stages.json", {"scenes": "x", "map": "y"})
    Dataset(folder / "data" / "rooms", (scene,)).save()
    model = camera.colmap
    described = f"{{model: {model.model}, width: {model.width}, height: {model.height}, params: {list(model.params)}}}"
    (folder / "rooms.yaml").write_text(f"name: rooms\ncamera: {described}\n")
    return ["--config", str(folder / "rooms.yaml"), "--data", str(folder / "data"), "--device", "cpu"]


def planned(folder: Path, camera: Camera, method: str, film: str = "none") -> tuple[PlannedPath, pd.DataFrame, Scorer]:
    """A path through the room, its table, and the scorer that it was planned by."""
    ends = ["--start", str(list(START)), "--goal", str(list(GOAL)), "--out", str(folder / "way")]
    lattice = ["--plan.grid", "[3, 3, 2]", "--plan.directions", "40", "--plan.planner.spacing_m", "0.8"]
    chosen = ["--scene", "room", "--method", method, "--film", film]
    chosen += ["--plan.weights", str(WEIGHTS)] if method == "set" else []
    experiment = parse_command("plan", [*options(folder, camera), *ends, *lattice, *chosen])
    assert experiment is not None

    def within(seconds: float) -> PlannedPath:
        planner = replace(experiment.plan.planner, time_s=seconds)
        return replace(experiment, plan=replace(experiment.plan, planner=planner)).run()

    path = patiently(within)
    scorer = make_scorer(method, LocalizationMap(LANDMARKS, camera, occlusion()), weights=experiment.plan.weights)
    return path, pd.read_csv(folder / "way" / "path.csv"), scorer


@pytest.mark.parametrize("method", ["visible", "set"])
def test_a_views_score_is_that_of_its_very_pose(tmp_path: Path, method: str) -> None:
    """A rule that is planned by its ranks, and a learned method."""
    path, table, scorer = planned(tmp_path, OFF_CENTER, method)
    looking = poses_looking_along(path.positions, path.axes)
    np.testing.assert_allclose(poses(table), looking, atol=1e-9)
    np.testing.assert_allclose(table["score"], scorer.score(looking), rtol=1e-5)
    np.testing.assert_array_equal(table["score"], path.scores)
    beside = path.positions + np.random.default_rng(0).uniform(-0.4, 0.4, path.positions.shape)
    assert not np.allclose(table["score"], scorer.score(poses_looking_along(beside, path.axes)), rtol=1e-3)


def test_a_path_that_nobody_scores_has_no_scores(tmp_path: Path) -> None:
    assert planned(tmp_path, OFF_CENTER, "forward")[1]["score"].isna().all()


@pytest.mark.slow
def test_a_fisheye_is_planned_for_and_shown(tmp_path: Path) -> None:
    _, table, scorer = planned(tmp_path, FISHEYE, "bins", "gif")
    assert scorer.localization_map.camera == FISHEYE and len(table) > 2
    np.testing.assert_allclose(table["score"], scorer.score(poses(table)), rtol=1e-9)
    assert {file.name for file in (tmp_path / "way").iterdir()} == {"path.csv", "path.png", "path.gif"}
    given = parse_command("viewpoint-map", ["--config", str(tmp_path / "rooms.yaml"), "--data",
        str(tmp_path / "data"), "--device", "cpu", "--method", "bins", "--viewpoint_map.grid", "[3, 3, 2]",
        "--viewpoint_map.directions", "20"])  # fmt: skip
    assert given is not None
    given.run()
    views = ViewpointMap.load(tmp_path / "data" / "rooms" / "room" / "viewpoint-map")
    assert views.origin.camera["model"] == "OPENCV_FISHEYE"
    at = poses_looking_along(np.repeat(views.locations[:1], 20, axis=0), views.directions)
    np.testing.assert_allclose(views.scores[0], scorer.score(at), rtol=1e-6)
