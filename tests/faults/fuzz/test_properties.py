"""Whatever settings, options and numbers are given, what comes is a result or a typed error."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import numpy as np
import pytest
import yaml

from wheretolook.cli import STAGES, parse_experiment
from wheretolook.config import Experiment
from wheretolook.geometry.camera import PinholeCamera, camera_of, camera_of_record
from wheretolook.geometry.lattices import ViewLattice, VoxelGrid, direction_lattice
from wheretolook.geometry.poses import check_poses, poses_looking_along
from wheretolook.select.waypoints import Waypoints
from wheretolook.utils.errors import ConfigError, PoseError, TableError
from wheretolook.utils.options import all_options

pytest.importorskip("hypothesis", reason="hypothesis is not installed: pip install -e '.[test]'")

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

OPTIONS = [name for name, option in all_options(Experiment).items() if not (option.is_group or option.is_fixed)]
NUMBERS = st.one_of(
    st.integers(-3, 10), st.integers(), st.floats(), st.sampled_from([2**31, 2**63, 2**64, 1e308, -0.0, 5e-324])
)
VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, st.text(max_size=20), st.sampled_from(["../x", "/x", "nan", "a/b"])),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)
some = settings(max_examples=50, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)


@some
@given(st.dictionaries(st.sampled_from(OPTIONS), VALUES, min_size=1, max_size=3), st.sampled_from(sorted(STAGES)))
def test_settings_in_a_file(tmp_path_factory: pytest.TempPathFactory, found: dict[str, Any], stage: str) -> None:
    content: dict[str, Any] = {}
    for name, value in found.items():
        *groups, last = name.split(".")
        at = content
        for group in groups:
            at = at.setdefault(group, {})
        at[last] = value
    path = tmp_path_factory.getbasetemp() / "settings.yaml"
    path.write_text(yaml.safe_dump(content, allow_unicode=True), encoding="utf-8", errors="replace")
    try:
        experiment = parse_experiment(stage, ["--config", str(path)])
    except ConfigError as error:
        assert str(path) in str(error)
    else:
        assert experiment is not None
        assert experiment.root.resolve().is_relative_to(experiment.data.resolve())


@some
@given(st.sampled_from(OPTIONS), st.one_of(st.text(max_size=20), NUMBERS.map(str), VALUES.map(repr)))
def test_options_of_the_command_line(name: str, value: str) -> None:
    try:
        assert parse_experiment("map", [f"--{name}", value]) is not None
    except ConfigError as error:
        assert "wheretolook map --help-all" in str(error) or error.fix


@some
@given(NUMBERS, NUMBERS, NUMBERS, NUMBERS, st.tuples(NUMBERS, NUMBERS))
def test_cameras_of_any_numbers(width: Any, height: Any, focal: Any, focal_y: Any, center: Any) -> None:
    try:
        camera = PinholeCamera(width, height, focal, focal_y, center)
    except ConfigError:
        return
    assert np.isfinite(camera.matrix).all() and camera.mean_focal_px > 0
    for made in (camera, camera.colmap):
        assert camera_of_record(made.record()) == camera
        seen = made.in_image(made.project([[0.0, 0, 1], [1, 2, -1], [0, 0, 0], [1e300, 0, 1]]))
        assert seen.shape == (4,)


@some
@given(st.sampled_from(["OPENCV", "SIMPLE_RADIAL", "OPENCV_FISHEYE", "FOV", "EQUIRECTANGULAR", "X"]), st.data())
def test_cameras_of_colmap_of_any_numbers(model: str, data: st.DataObject) -> None:
    good = {"OPENCV": 8, "SIMPLE_RADIAL": 4, "OPENCV_FISHEYE": 8, "FOV": 5, "EQUIRECTANGULAR": 0, "X": 1}
    params = data.draw(st.lists(NUMBERS, min_size=good[model], max_size=good[model]))
    try:
        camera = camera_of(model, data.draw(NUMBERS), data.draw(NUMBERS), params)
    except ConfigError:
        return
    pixels = camera.project([[0.1, 0.2, 1.0], [0, 0, 0], [1e300, 0, 1], [0, 0, -1]])
    assert pixels.shape == (4, 2)


@some
@given(st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS), min_size=1, max_size=3), st.tuples(NUMBERS, NUMBERS, NUMBERS))
def test_poses_of_any_numbers(locations: Any, direction: Any) -> None:
    try:
        poses = poses_looking_along(locations, [direction] * len(locations))
    except PoseError:
        assert not (np.isfinite(np.array([*locations, direction], float)).all() and 0 < math.hypot(*direction) < 1e150)
        return
    assert check_poses(poses).shape == (len(locations), 3, 4)
    np.testing.assert_allclose(
        poses[:, :, :3] @ poses[:, :, :3].swapaxes(1, 2), np.tile(np.eye(3), (len(poses), 1, 1)), atol=1e-9
    )


@some
@given(
    st.tuples(NUMBERS, NUMBERS, NUMBERS), st.tuples(NUMBERS, NUMBERS, NUMBERS), st.tuples(*[st.integers(-2, 50)] * 3)
)
def test_grids_of_any_numbers(lower: Any, upper: Any, shape: Any) -> None:
    try:
        grid = VoxelGrid(lower, upper, shape)
    except ConfigError:
        return
    ids = grid.location_ids([lower, upper, (0.0, 0.0, 0.0), (math.nan, 0, 0), (1e308, -1e308, 0)])
    assert ((ids >= -1) & (ids < len(grid))).all()
    assert grid.centers().shape == (len(grid), 3)


@some
@given(st.tuples(NUMBERS, NUMBERS, NUMBERS), st.integers(-5, 3000), st.text(max_size=5) | st.just("fibonacci"))
def test_lattices_of_any_numbers(shape: Any, directions: Any, name: Any) -> None:
    try:
        lattice = ViewLattice(shape, directions, name)
    except ConfigError:
        return
    np.testing.assert_allclose(np.linalg.norm(lattice.axes(), axis=1), 1, atol=1e-12)
    assert len(direction_lattice(directions)) == directions


@some
@given(VALUES)
def test_waypoints_of_any_values(values: Any) -> None:
    with contextlib.suppress(TableError):
        assert np.isfinite(Waypoints.of(values).points).all()
