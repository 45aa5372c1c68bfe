"""Pose files hold the poses that were written, and invalid ones are rejected."""

import os

import pandas as pd
import pytest
from numpy.testing import assert_allclose

from wheretolook.geometry.pose_files import (
    MAX_ROWS,
    POSE_COLUMNS,
    pose_texts,
    pose_values,
    poses_of_values,
    read_rows,
    tum_text,
)
from wheretolook.geometry.poses import camera_centers, invert_poses, poses_looking_along, quaternion_from_rotation
from wheretolook.geometry.views import Views
from wheretolook.mapping.georeference import read_positions
from wheretolook.select.waypoints import read_waypoints
from wheretolook.utils.errors import ConfigError, TableError

POSES = poses_looking_along([(1.5, -2, 0.25), (0, 3, 1)], [(1, 0, 0), (-1, 2, 0.5)])


def test_round_trips(tmp_path):
    (tmp_path / "path.tum").write_text("# a comment\n" + tum_text(["0.5", "1"], POSES))
    pd.DataFrame(pose_values(POSES), columns=[*POSE_COLUMNS]).to_csv(tmp_path / "path.csv")
    world = invert_poses(POSES)
    views = pd.DataFrame(quaternion_from_rotation(world[..., :3]), columns=["qw", "qx", "qy", "qz"])
    views.assign(**dict(zip("xyz", world[..., 3].T, strict=True))).to_csv(tmp_path / "views.csv")
    (tmp_path / "poses.csv").write_text((tmp_path / "path.csv").read_text().replace(",", ";"))
    image = "2 {} 1 a b.jpg\n10.5 20.5 -1 11.5 20.5 3\n"
    first, second = pose_texts(POSES)
    (tmp_path / "images.txt").write_text(f"# comment\n1 {first} 1 a.jpg\n\n" + image.format(second))
    for name in ("path.tum", "path.csv", "views.csv", "poses.csv", "images.txt"):
        assert_allclose(Views.read(tmp_path / name).cam_from_world, POSES, atol=1e-8)
    assert Views.read(tmp_path / "images.txt").waypoint_id == ("a.jpg", "a b.jpg")
    assert Views.read(tmp_path / "path.tum").waypoint_id == ("0.5", "1")


@pytest.mark.parametrize("time", ["t", "timestamp", None])
def test_header_in_the_order_of_tum(time, tmp_path):
    """A camera at (1, 2, 3) that looks along the world's x, its image upright: quaternion xyzw -0.5, 0.5, -0.5, 0.5."""
    names, values = "tx,ty,tz,qx,qy,qz,qw", "1,2,3,-0.5,0.5,-0.5,0.5"
    path = tmp_path / "path.csv"
    path.write_text(f"{names}\n{values}\n" if time is None else f"{time},{names}\n0.5,{values}\n")
    views = Views.read(path)
    ids, poses = views.waypoint_id, views.cam_from_world
    assert ids == ("0" if time is None else "0.5",)
    assert_allclose(poses, poses_looking_along([(1, 2, 3)], [(1, 0, 0)]), atol=1e-12)
    assert read_waypoints(path).points.tolist() == [[1, 2, 3]]


@pytest.mark.parametrize("names", ["tx,ty,tz,qw,qx,qy,qz", "qx,qy,qz,qw,tx,ty,tz"])
def test_header_in_an_order_of_no_convention(names, tmp_path):
    (tmp_path / "path.csv").write_text(f"{names}\n0.5,0.5,0.5,0.5,0.5,0.5,0.5\n")
    for read in (Views.read, read_waypoints):
        with pytest.raises(TableError, match=r"TUM.*camera-to-world.*COLMAP.*world-to-camera"):
            read(tmp_path / "path.csv")


def test_texts_keep_the_centre_of_a_camera_far_away():
    for exact, offset, limit in ((True, 0, 1e-15), (False, 0, 1e-8), (False, 1e6, 1e-8)):
        poses = poses_looking_along(camera_centers(POSES) + offset, POSES[:, 2, :3])
        again = poses_of_values([[float(cell) for cell in text.split()] for text in pose_texts(poses, exact)])
        assert_allclose(camera_centers(again), camera_centers(poses), rtol=1e-15, atol=limit)


def test_rows(tmp_path):
    path = tmp_path / "rows"
    path.write_text('\ufeff# comment\n\n"a; b"; 1;2\nc;3\n', encoding="utf-8")
    assert read_rows(path) == [(3, ["a; b", "1", "2"]), (4, ["c", "3"])]


def test_large_tables_are_rejected_without_reading_them(tmp_path):
    path = tmp_path / "rows"
    path.write_text("1\n" * (MAX_ROWS + 1))
    with pytest.raises(TableError):
        read_rows(path)
    os.truncate(path, 2_000_000_000)
    for read in (read_rows, Views.read, read_waypoints, read_positions):
        with pytest.raises((TableError, ConfigError), match="16,000,000 bytes"):
            read(path)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"# x\n",
        b"\xff\xfe\x00",
        b"1 2 3\n",
        b"1 2 3 4 5 6 7 x\n",
        b"0 1 2 3 1 0 0 0\n1 2 3\n",
        b"0 1 2 3 1 0 0 0\n1 2 3 4 0 0 0 2\n",  # no unit quaternion
        b"0 1 2 3 1 0 0 0\n1 2 3 nan 0 0 0 1\n",
        b"x,y,z,yaw\n1,2,3,4\n",
        b"x,y,z,qw,qx,qy,qz\n",
        b"x,y,z,qw,qx,qy,qz\n1,2,3,1,0,0,0,0\n",
        b"x,x,y,z,qw,qx,qy,qz\n1,1,2,3,1,0,0,0\n",
        b"1 1 0 0 0 0 0 0 1 a.jpg\n\n2 3 0 0 0 0 0 0 1 b.jpg\n\n",
    ],
)
def test_invalid_files(content, tmp_path):
    for name in ("path.tum", "path.csv", "images.txt"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(TableError):
            Views.read(str(tmp_path / name))
