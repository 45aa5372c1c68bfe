"""Paths of a scene by the plan and viewpoint-map stages, seen by a pinhole and by a fisheye."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from planning.rooms import occlusion, patiently, room_landmarks, write_room_dataset
from wheretolook.cli import parse_command
from wheretolook.dataset.viewpoint_table import poses
from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.map import Map
from wheretolook.scorers.registry import make_scorer

LANDMARKS = room_landmarks(300)
WEIGHTS = Path(__file__).parents[2] / "data" / "release" / "weights" / "set.safetensors"
OFF_CENTER = PinholeCamera(160, 120, 80.0, 85.0, (74.0, 65.0))
FISHEYE = ColmapCamera("OPENCV_FISHEYE", 160, 120, (55.0, 55.0, 80.0, 60.0, 0.01, -0.002, 0.0, 0.0))
START = (1.0, 1.0, 1.4)
GOAL = (2.8, 1.6, 1.4)


@pytest.fixture(autouse=True)
def untracked(monkeypatch):
    """A new tracking store takes seconds to make."""
    monkeypatch.setattr(import_module("wheretolook.commands.plan"), "_log", lambda *given: None)


def options(folder, camera):
    """Write a dataset of one room; return the options that name it."""
    write_room_dataset(folder, LANDMARKS, camera)
    model = camera.colmap
    described = f"{{model: {model.model}, width: {model.width}, height: {model.height}, params: {list(model.params)}}}"
    (folder / "rooms.yaml").write_text(f"name: rooms\ncamera: {described}\n")
    return ["--config", str(folder / "rooms.yaml"), "--data", str(folder / "data"), "--device", "cpu"]


def planned(folder, camera, method, film="none"):
    """Plan a path through the room; return it, its table and its scorer."""
    ends = ["--start", str(list(START)), "--goal", str(list(GOAL)), "--out", str(folder / "way")]
    lattice = ["--plan.grid", "[3, 3, 2]", "--plan.directions", "40", "--plan.planner.spacing_m", "0.8"]
    chosen = ["--scene", "a", "--method", method, "--film", film]
    chosen += ["--plan.weights", str(WEIGHTS)] if method == "set" else []
    experiment = parse_command("plan", [*options(folder, camera), *ends, *lattice, *chosen])
    assert experiment is not None

    def within(seconds):
        planner = replace(experiment.plan.planner, time_s=seconds)
        return replace(experiment, plan=replace(experiment.plan, planner=planner)).run()

    path = patiently(within)
    scorer = make_scorer(method, LocalizationMap(Map(LANDMARKS), camera, occlusion()), weights=experiment.plan.weights)
    return path, pd.read_csv(folder / "way" / "path.csv"), scorer


@pytest.mark.parametrize("method", ["visible", "set"])
def test_a_views_score_is_that_of_its_very_pose(tmp_path, method):
    """A rule that is planned by its ranks, and a learned method."""
    path, table, scorer = planned(tmp_path, OFF_CENTER, method)
    looking = poses_looking_along(path.positions, path.axes)
    np.testing.assert_allclose(poses(table), looking, atol=1e-9)
    np.testing.assert_allclose(table["score"], scorer.score(looking), rtol=1e-5)
    np.testing.assert_allclose(table["score"], path.scores, rtol=1e-6)  # read from text
    elsewhere = path.positions + np.random.default_rng(0).uniform(-0.4, 0.4, path.positions.shape)
    assert not np.allclose(table["score"], scorer.score(poses_looking_along(elsewhere, path.axes)), rtol=1e-3)


def test_a_path_that_nobody_scores_has_no_scores(tmp_path):
    assert planned(tmp_path, OFF_CENTER, "forward")[1]["score"].isna().all()


@pytest.mark.slow
def test_a_fisheye_is_planned_for_and_shown(tmp_path):
    _, table, scorer = planned(tmp_path, FISHEYE, "bins", "gif")
    assert scorer.localization_map.camera == FISHEYE and len(table) > 2
    np.testing.assert_allclose(table["score"], scorer.score(poses(table)), rtol=1e-9)
    assert {file.name for file in (tmp_path / "way").iterdir()} == {"path.csv", "path.png", "path.gif"}
