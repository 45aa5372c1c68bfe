"""Choosing viewpoints by what they see."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from synthetic_dataset import make_landmarks
from wheretolook.dataset.config import SampleConfig
from wheretolook.dataset.sampling import sample_viewpoints
from wheretolook.dataset.viewpoint_files import SCHEMA
from wheretolook.dataset.viewpoint_table import poses
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import VoxelGrid, fibonacci_sphere
from wheretolook.geometry.poses import camera_centers, poses_looking_along, transform
from wheretolook.utils.errors import ConfigError
from wheretolook.visibility.occlusion import NoOcclusion

CAMERA = PinholeCamera(320, 240, 160.0)
GRID = VoxelGrid((-2.0, -2.0, 0.0), (2.0, 2.0, 2.0), (4, 4, 2))


@pytest.fixture
def landmarks():
    """A wall at x = 5."""
    rng = np.random.default_rng(0)
    points = np.column_stack([np.full(300, 5.0), rng.uniform(-3, 3, 300), rng.uniform(0, 2, 300)])
    return make_landmarks(rng, 300, points=points)


def sampled(landmarks, **options):
    config = SampleConfig(directions=100, **options)
    return sample_viewpoints(GRID, np.arange(len(GRID)), landmarks, CAMERA, NoOcclusion(), config)


def test_rows_say_what_their_viewpoint_sees(landmarks):
    table, _ = sampled(landmarks, keep=20)
    assert set(table.columns) == set(SCHEMA.names)
    seen = transform(poses(table), landmarks.points)
    inside = (seen[..., 2] > 1e-3) & CAMERA.in_image(CAMERA.project(seen))
    assert np.abs(inside.sum(1) - table["n_visible"]).max() <= 1  # single precision at the border
    assert_allclose(camera_centers(poses(table)), GRID.centers()[table["location_id"]], atol=1e-12)
    assert_allclose(poses(table)[:, 2, :3], fibonacci_sphere(100)[table["direction_id"]], atol=1e-12)
    assert (table["viewpoint_id"] == table["location_id"] * 100 + table["direction_id"]).all()


MAPPED = poses_looking_along(np.array([[-1.5, -1.5, 1.0], [-1.5, 1.5, 1.0]]), np.array([[0.5, 1, 0]] * 2))


def sampled_near(landmarks, **options):
    """Half of 60 locations are near `MAPPED`."""
    grid = VoxelGrid((-2.0, -2.0, 0.0), (2.0, 2.0, 2.0), (20, 20, 10))
    config = SampleConfig(directions=400, max_locations=60, near_map=0.5, **options)
    return sample_viewpoints(grid, np.arange(len(grid)), landmarks, CAMERA, NoOcclusion(), config, mapped=MAPPED)[0]


def test_a_share_of_the_viewpoints_is_near_mapping_images(landmarks):
    table = sampled_near(landmarks, keep=0, min_visible=0, max_directions=8)
    assert table.groupby("location_id").size().eq(8).all() and table["location_id"].nunique() == 60
    centers = camera_centers(poses(table))
    distance_m = np.linalg.norm(centers[:, None] - camera_centers(MAPPED), axis=2).min(1)
    ahead = poses(table)[:, 2, :3] @ MAPPED[0, 2, :3]  # cosine to the axis of both images
    near = pd.Series(ahead > np.cos(np.radians(40))).groupby(table["location_id"]).all()
    assert 20 <= near.sum() <= 30  # of 30 draws some share a voxel; of the others eight random directions never agree
    distance_m = pd.Series(distance_m).groupby(table["location_id"]).first()
    # three standard deviations of 0.2 m along each axis and half a voxel's diagonal
    assert distance_m[near].max() < np.sqrt(3) * (0.6 + 0.1) and distance_m[~near].median() > 1


def test_near_map_and_keep_take_the_best_of_the_directions_near_those_of_images(landmarks):
    everything, best = (sampled_near(landmarks, keep=keep) for keep in (0, 5))
    assert everything["location_id"].nunique() == best["location_id"].nunique() == 60
    expected = everything.sort_values("visibility_rank").groupby("location_id").head(5).sort_values("viewpoint_id")
    pd.testing.assert_frame_equal(best, expected.reset_index(drop=True))
    assert best["visibility_rank"].max() >= 5  # not the five that see most of all


@pytest.mark.parametrize(
    ("options", "missing"), [({"near_map": 0.5}, "max_locations"), ({"any_lens": True}, "cameras")]
)
def test_options_that_need_another_one_are_refused_without(options, missing):
    with pytest.raises(ConfigError, match=missing):
        SampleConfig(**options)


def test_each_location_looks_with_one_of_several_cameras(landmarks):
    cameras = {1: PinholeCamera(160, 120, 60.0), 2: PinholeCamera(80, 160, 150.0, center_px=(44.0, 77.0))}
    config = SampleConfig(directions=100, keep=0, min_visible=0)
    ids = np.arange(len(GRID))
    table, occlusion = sample_viewpoints(GRID, ids, landmarks, cameras, NoOcclusion(), config)
    assert set(table.columns) == {*SCHEMA.names, "camera_id"}
    assert table.groupby("location_id")["camera_id"].nunique().max() == 1
    assert table.groupby("camera_id")["location_id"].nunique().tolist() == [len(GRID) // 2] * 2
    for number, camera in cameras.items():
        alone, same = sample_viewpoints(GRID, ids, landmarks, camera, NoOcclusion(), config)
        rows = (table["camera_id"] == number).to_numpy()
        pd.testing.assert_frame_equal(table[rows].drop(columns="camera_id"), alone[rows])
        assert_array_equal(occlusion.packed, same.packed)


def test_the_best_directions_are_kept_and_ranked(landmarks):
    everything, _ = sampled(landmarks, keep=0, min_visible=0)
    best, _ = sampled(landmarks, keep=7)
    assert len(everything) == len(GRID) * 100
    for location, rows in best.groupby("location_id"):
        counts = everything[everything["location_id"] == location].sort_values(
            ["n_visible", "direction_id"], ascending=[False, True]
        )
        assert (
            rows.sort_values("visibility_rank")["direction_id"].tolist() == counts["direction_id"].tolist()[: len(rows)]
        )
        assert sorted(rows["visibility_rank"]) == list(range(len(rows))) and len(rows) <= 7
        assert (rows["n_visible"] >= 1).all()


def test_subsets_are_drawn_by_seed(landmarks):
    options = {"keep": 20, "max_locations": 9, "max_directions": 5}
    first, stored = sampled(landmarks, **options, seed=1)
    again, _ = sampled(landmarks, **options, seed=1)
    other, _ = sampled(landmarks, **options, seed=2)
    pd.testing.assert_frame_equal(first, again)
    assert not first["viewpoint_id"].equals(other["viewpoint_id"])
    assert first["location_id"].nunique() == 9 == len(stored.locations)
    assert first.groupby("location_id").size().max() == 5
    assert first["viewpoint_id"].is_monotonic_increasing and first["viewpoint_id"].is_unique


@pytest.mark.parametrize(
    "options",
    [{"keep": -1}, {"max_directions": -1}, {"max_directions": {"train": 3}},
     {"max_directions": {"train": 3, "val": 1, "test": -1}}],
)  # fmt: skip
def test_directions_may_differ_by_split(options):
    config = SampleConfig(max_directions={"train": 3, "val": 0, "test": 7})
    assert [config.directions_of(split) for split in ("train", "val", "test")] == [3, 0, 7]
    with pytest.raises(ConfigError):
        SampleConfig(**options)
