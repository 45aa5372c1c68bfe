"""Paths between walls: never through them, never beyond what the camera can do, and past what can be seen."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from selection.room import write_room
from wheretolook.geometry.lattices import VoxelGrid, axes_of_angles, fibonacci_sphere
from wheretolook.geometry.poses import (
    pan_tilt_angles,
    pan_tilt_turns_deg,
    rotation_angle_deg,
    rotation_looking_along,
    turns_deg as turns_deg_of_cameras,
)
from wheretolook.planning.config import PathConfig
from wheretolook.planning.routes import turned_evenly
from wheretolook.planning.rrt import are_separate, plan_path
from wheretolook.planning.viewpoint_map import MapOrigin, ViewpointMap
from wheretolook.utils.errors import ConfigError, PlanningError

LOW = np.array([0.0, 0.0, 0.5])
HIGH = np.array([6.0, 4.0, 1.7])
WALL = ((2.9, 0.0), (3.1, 3.0))  # from the floor to the ceiling, with a gap at y > 3


class Room:
    """A box with one wall across most of it."""

    def is_free(self, points):
        points = np.atleast_2d(np.asarray(points, dtype=float))
        inside = ((points >= LOW) & (points <= HIGH)).all(1)
        low, high = np.array(WALL)
        return inside & ((points[:, :2] < low) | (points[:, :2] > high)).any(1)

    def segments_are_free(self, a, b):
        """Exactly: a segment meets the wall where it is within both of its slabs at once."""
        a, b = (np.atleast_2d(np.asarray(points, dtype=float)) for points in (a, b))
        step = (b - a)[:, :2]
        step = np.where(np.abs(step) < 1e-12, 1e-12, step)
        enter, leave = (np.sort([(side - a[:, :2]) / step for side in np.array(WALL)], axis=0)[k] for k in (0, 1))
        meets = np.maximum(enter.max(1), 0) <= np.minimum(leave.min(1), 1)
        return self.is_free(a) & self.is_free(b) & ~meets


BOUNDS = (LOW, HIGH)
START = (1.0, 1.0, 1.1)
GOAL = (5.0, 1.0, 1.1)
QUICK = PathConfig(time_s=1.5, pitch_deg=(-30, 30))


def looking_north():
    """Everywhere the same: the nearer to +y a view looks, the better."""
    grid = VoxelGrid(tuple(LOW), tuple(HIGH), (6, 4, 2))
    directions = fibonacci_sphere(200)
    scores = np.tile(((1 + directions[:, 1]) / 2) ** 2, (len(grid), 1)).astype(np.float32)
    return ViewpointMap(
        grid=grid,
        row_of_voxel=np.arange(len(grid), dtype=np.int32),
        directions=directions,
        ranked=np.argsort(-scores, axis=1, kind="stable").astype(np.uint16),
        scores=scores,
        n_visible=np.ones_like(scores, dtype=np.uint32),
        landmark_ids=np.zeros(0, np.int64),
        landmark_digests=np.zeros((0, 2), np.uint64),
        origin=MapOrigin("made", "fibonacci", {}, "none", "0" * 16),
    )


def check(path, config=QUICK):
    """Assert that a path is inside the free space, from start to goal, and within the camera's limits."""
    room = Room()
    np.testing.assert_allclose(path.positions[[0, -1]], [START, GOAL], atol=1e-6)
    assert room.is_free(path.positions).all()
    assert room.segments_are_free(path.positions[:-1], path.positions[1:]).all()
    steps = np.linalg.norm(np.diff(path.positions, axis=0), axis=1)
    assert steps.max() <= config.spacing_m + 1e-9
    np.testing.assert_allclose(np.linalg.norm(path.axes, axis=1), 1, atol=1e-9)
    pitch = np.degrees(np.arcsin(path.axes[:, 2]))
    assert config.pitch_deg[0] - 1e-6 <= pitch.min() and pitch.max() <= config.pitch_deg[1] + 1e-6


def test_forward_takes_the_short_way_through_the_gap():
    path = plan_path(START, GOAL, Room(), BOUNDS, config=QUICK, progress=False)
    check(path)
    shortest = 2 * np.hypot(1.9, 2.0) + 0.2  # round both corners of the wall
    assert shortest - 0.01 <= path.length_m <= 1.03 * shortest
    assert path.cost == pytest.approx(path.length_m, rel=1e-6) and np.isnan(path.scores).all()
    travel = np.diff(path.positions, axis=0)[:, :2]
    travel /= np.linalg.norm(travel, axis=1, keepdims=True)
    assert np.quantile((path.axes[1:-1, :2] * travel[1:]).sum(1), 0.2) > 0.7 and np.all(path.axes[:, 2] == 0)


def test_the_camera_looks_where_it_localizes():
    axis = np.append(np.random.default_rng(0).normal(size=2), 0.0)
    path = plan_path(START, GOAL, Room(), BOUNDS, looking_north(), QUICK, start_axis=axis, progress=False)
    check(path)
    np.testing.assert_allclose(path.axes[0], axis / np.linalg.norm(axis), atol=1e-6)
    steps = np.linalg.norm(np.diff(path.positions, axis=0), axis=1)
    turns_deg = np.degrees(np.arccos((path.axes[1:] * path.axes[:-1]).sum(1).clip(-1, 1)))
    assert (turns_deg <= QUICK.max_turn_deg_per_m * steps + 1e-6).all()
    assert path.axes[len(path.axes) // 3 :, 1].mean() > 0.8  # north, once there was time to turn
    assert np.isfinite(path.scores).all() and path.scores.mean() > 0.7
    assert path.length_m < 1.4 * (2 * np.hypot(1.9, 2.0) + 0.2) and path.turn_deg > 0


def test_limits_hold_where_the_best_views_are_at_them():
    """Every voxel its own: views near the limits of the pitch are best, here and there."""
    views = looking_north()
    limits = (5, 40)
    pitch = np.degrees(np.arcsin(views.directions[:, 2]))
    near = np.exp(-np.abs(pitch[:, None] - limits).min(1) / 3)
    scores = (near * np.random.default_rng(1).random(views.scores.shape)).astype(np.float32)
    views = replace(views, scores=scores, ranked=np.argsort(-scores, axis=1, kind="stable").astype(np.uint16))
    config = PathConfig(time_s=1.0, pitch_deg=limits)
    path = plan_path(START, GOAL, Room(), BOUNDS, views, config, progress=False)
    check(path, config)
    rotations = rotation_looking_along(path.axes)
    steps = np.linalg.norm(np.diff(path.positions, axis=0), axis=1)
    assert (rotation_angle_deg(rotations[1:], rotations[:-1]) <= config.max_turn_deg_per_m * steps + 1e-4).all()


def test_a_camera_turns_evenly_between_views_and_never_above_them():
    axes = axes_of_angles(np.array([[170.0, 40.0], [-151.0, 40.0], [-151.0, 10.0]]))
    at = np.linspace(0, 2, 9)
    turned = turned_evenly(np.arange(3.0), axes, at)
    yaw, pitch = (np.degrees(part) for part in pan_tilt_angles(turned))
    np.testing.assert_allclose(pitch, np.interp(at, [0, 1, 2], [40, 40, 10]), atol=1e-9)
    np.testing.assert_allclose(yaw % 360, np.interp(at, [0, 1, 2], [170, 209, 209]) % 360, atol=1e-9)


def test_a_pan_tilt_head_turns_no_less_than_the_camera():
    axes = fibonacci_sphere(100)[10:90]
    apart = pan_tilt_turns_deg(axes, axes)
    assert (apart >= turns_deg_of_cameras(axes) - 1e-6).all() and apart.min() == 0
    level = axes_of_angles(np.array([[0.0, 0.0], [30.0, 0.0], [-170.0, 0.0], [180.0, 40.0]]))
    np.testing.assert_allclose(pan_tilt_turns_deg(level, level)[2], [170, 160, 0, np.hypot(10, 40)], atol=1e-9)


class ClosedRoom(Room):
    """A room in two parts."""

    def segments_are_free(self, a, b):
        return super().segments_are_free(a, b) & ((np.atleast_2d(a)[:, 0] < 3) == (np.atleast_2d(b)[:, 0] < 3))


class TwoRooms(ClosedRoom):
    """The wall goes all the way across."""

    def is_free(self, points):
        return super().is_free(points) & (np.abs(np.atleast_2d(points)[:, 0] - 3) > 0.1)


def test_separate_rooms_are_named_as_the_cause():
    assert not are_separate(np.array([START, GOAL]), Room(), np.array(BOUNDS))
    with pytest.raises(PlanningError, match="separate parts"):
        plan_path(START, GOAL, TwoRooms(), BOUNDS, config=replace(QUICK, time_s=0.3), progress=False)


@pytest.mark.parametrize(
    "change, error",
    [
        ({"start": (3.0, 1.0, 1.1)}, PlanningError),
        ({"goal": START}, PlanningError),
        ({"start_axis": (0.1, 0, 1)}, PlanningError),
        ({"start_axis": (1, 0, 0), "viewpoint_map": None}, PlanningError),
        ({"space": ClosedRoom(), "config": PathConfig(time_s=0.5)}, PlanningError),
        ({"start": (np.nan, 0, 1)}, ValueError),
    ],
)
def test_impossible_requests(change, error):
    request = {"start": START, "goal": GOAL, "space": Room(), "bounds": BOUNDS, "config": QUICK}
    with pytest.raises(error):
        plan_path(**{**request, "viewpoint_map": looking_north(), **change}, progress=False)


@pytest.mark.parametrize(
    "options", [{"pitch_deg": (40, -40)}, {"pitch_deg": (-0.7, 0.7)}, {"spacing_m": np.inf}, {"score_weight": -1}]
)
def test_invalid_options(options):
    with pytest.raises(ConfigError):
        PathConfig(**options)


@pytest.mark.slow
def test_the_command_leaves_no_reports_of_leaks(tmp_path):
    """The bindings of OMPL report objects that the exit of Python leaves."""
    given = ["plan", "--map", str(write_room(tmp_path / "room")), "--method", "visible", "--device", "cpu"]
    given += ["--start", "2,2,1.5", "--goal", "3.9,2.7,1.4", "--plan.planner.time_s", "0.1"]
    given += ["--viewpoint_map.grid", "6,5,3", "--viewpoint_map.directions", "10"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    run = [sys.executable, "-m", "wheretolook", *given]
    done = subprocess.run(run, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "leak" not in done.stderr + done.stdout
