"""The unit and the direction up of a map are stated, measured, or known to be unknown; scores do not depend on them."""

import csv
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from selection.room import POINTS, WEIGHTS
from wheretolook.geometry.similarity import Similarity
from wheretolook.mapping.colmap_model import colmap_poses, model_arrays, write_model
from wheretolook.mapping.config import FrameOptions
from wheretolook.mapping.georeference import DEPTH_M, median_depths
from wheretolook.mapping.map_frame import find_frame
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.utils.errors import ConfigError, MapError, MapWarning, TableError

Y_DOWN = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # from z up to y down


def in_other_units(room, folder, unit, turn=np.eye(3)):
    """Write a room's model with coordinates in other units and axes, and no report; return the transform to these."""
    similarity = Similarity(unit, turn, np.array([3.0, -2.0, 1.0]) * unit)
    model = pycolmap.Reconstruction(room)
    similarity.transform_model(model)
    write_model(model, folder)
    return similarity


def frame_of(folder, **options):
    return find_frame(folder, pycolmap.Reconstruction(folder), FrameOptions(**options))


@pytest.mark.filterwarnings("ignore")
def test_scores_do_not_depend_on_unit_and_axes(sparse, tmp_path):
    def views_of(folder, to_map, **options):
        look = WhereToLook.from_colmap(folder, weights=WEIGHTS, directions=60, device="cpu", **options)
        views = look.best(to_map.apply(POINTS), 3)
        np.testing.assert_allclose(views.positions, to_map.apply(np.repeat(POINTS, 3, axis=0)), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(look.score(views.cam_from_world), views.score, rtol=1e-4)
        return views

    reference = views_of(tmp_path / "metric", in_other_units(sparse, tmp_path / "metric", 1.0), scale=1)
    unknown = []
    for unit in (0.01, 1.0, 270.0):
        folder = tmp_path / str(unit)
        to_map = in_other_units(sparse, folder, unit, Y_DOWN)
        views = views_of(folder, to_map, scale=1 / unit)
        assert (views.frame.scale.source, views.frame.gravity) == ("given", "levelled")
        np.testing.assert_allclose(views.score, reference.score, rtol=2e-3)
        np.testing.assert_allclose(views.pitch_deg, reference.pitch_deg, atol=1e-3)
        np.testing.assert_allclose(views.axes @ Y_DOWN, reference.axes, atol=1e-6)
        unknown.append(views_of(folder, to_map))
        assert unknown[-1].frame.scale.source == "unknown"
        np.testing.assert_allclose(unknown[-1].score, unknown[0].score, rtol=2e-3)
        np.testing.assert_allclose(unknown[-1].axes, unknown[0].axes, atol=1e-6)


def test_the_unit_is_stated_or_measured(sparse, tmp_path):
    assert frame_of(sparse).scale.source == "rendered" and frame_of(sparse).world_from_map.scale == 1
    in_other_units(sparse, tmp_path, 20.0)
    centers = {image.name: image.projection_center() for image in pycolmap.Reconstruction(sparse).images.values()}
    length_m = float(np.linalg.norm(centers["000.jpg"] - centers["005.jpg"]))
    table = tmp_path / "positions.csv"
    with table.open("w") as file:
        csv.writer(file).writerows([("image", "x", "y", "z"), *((name, *at) for name, at in centers.items())])
    for options, source in (
        ({"scale": 0.05}, "given"),
        ({"distance": ("000.jpg", "005.jpg", length_m)}, "distance"),
        ({"positions": table}, "positions"),
    ):
        frame = frame_of(tmp_path, **options)
        assert frame.scale.source == source and frame.scale.is_metric
        assert frame.world_from_map.scale == pytest.approx(0.05)
    assert frame_of(sparse, scale=1.01).scale.source == "given"  # agrees with the report
    unknown = frame_of(tmp_path)
    model = pycolmap.Reconstruction(tmp_path)
    depth = median_depths(model_arrays(model), colmap_poses(tmp_path, model))
    assert not unknown.scale.is_metric and len(unknown.doubts) == 1
    assert unknown.world_from_map.scale * np.median(depth[depth > 0]) == pytest.approx(DEPTH_M)


def test_the_direction_up(sparse, tmp_path):
    in_other_units(sparse, tmp_path, 1.0, Y_DOWN)
    for up, gravity in (
        (None, "levelled"),
        ("level", "levelled"),
        ("-y", "given"),
        ("0,-1,0.01", "given"),
        ((0, -1, 0), "given"),
    ):
        frame = frame_of(tmp_path, scale=1, up=up)
        assert frame.gravity == gravity
        np.testing.assert_allclose(frame.world_from_map.rotation[2], (0, -1, 0), atol=0.02)
    assert frame_of(tmp_path, scale=1, up="z").gravity == "given"
    np.testing.assert_array_equal(frame_of(tmp_path, scale=1, up="z").world_from_map.rotation, np.eye(3))


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"scale": 0}, ConfigError), ({"scale": float("nan")}, ConfigError),
        ({"scale": 2}, ConfigError),  # the report states metres
        ({"scale": 1, "distance": ("000.jpg", "001.jpg", 2.0)}, ConfigError),
        ({"distance": ("000.jpg", "nothing.jpg", 2.0)}, MapError),
        ({"distance": ("000.jpg", "000.jpg", 2.0)}, ConfigError),
        ({"distance": ("000.jpg", "001.jpg", -2.0)}, ConfigError),
        ({"distance": ("000.jpg", "001.jpg")}, ConfigError),
        ({"positions": Path("nothing.csv")}, TableError), ({"up": "level", "positions": Path("nothing.csv")}, ConfigError),
        ({"up": "w"}, ConfigError), ({"up": (0, 0, 0)}, ConfigError), ({"up": "0,0,0"}, ConfigError),
        ({"up": "1,2"}, ConfigError), *(({"up": up}, MapError) for up in ("y", "x", "0,0,-1")),
    ],
)  # fmt: skip
def test_invalid_options_are_rejected(sparse, tmp_path, options, error):
    folder = sparse
    if error is MapError and "up" in options:  # against the cameras' direction up
        folder = tmp_path
        in_other_units(sparse, folder, 1.0, Y_DOWN)
    with pytest.raises(error):
        frame_of(folder, **options)


def test_transforms_of_poses_and_points_agree(sparse):
    similarity = Similarity(2.5, Y_DOWN, np.array([1.0, 2.0, 3.0]))
    pose = colmap_poses(sparse)[0]
    point = np.array([2.0, 1.0, 0.5])
    moved = similarity.apply_to_poses(pose)
    np.testing.assert_allclose(
        moved[:, :3] @ similarity.apply(point) + moved[:, 3], 2.5 * (pose[:, :3] @ point + pose[:, 3])
    )
    np.testing.assert_allclose(similarity.inverse.apply(similarity.apply(point)), point)
    np.testing.assert_allclose(similarity.inverse.apply_to_poses(moved), pose, atol=1e-12)


def test_an_unknown_unit_is_reported(sparse, tmp_path):
    in_other_units(sparse, tmp_path, 3.0)
    with pytest.warns(MapWarning):
        WhereToLook.from_colmap(tmp_path, weights=WEIGHTS, directions=60, device="cpu")


def test_positions_whose_z_is_not_up_are_stated(sparse, tmp_path):
    model = pycolmap.Reconstruction(sparse)
    for turn, tilt_deg in ((np.eye(3), 0), (Y_DOWN, 90)):
        table = tmp_path / "positions.csv"
        centers = {image.name: turn @ image.projection_center() for image in model.images.values()}
        table.write_text("image,x,y,z\n" + "".join(f"{name},{x},{y},{z}\n" for name, (x, y, z) in centers.items()))
        frame = frame_of(sparse, positions=table)
        assert frame.tilt_deg == pytest.approx(tilt_deg, abs=3)
        assert ("90 degrees" in frame.describe()) == (tilt_deg == 90)
