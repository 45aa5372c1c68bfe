"""Pose files hold the poses that were written, and invalid ones are rejected."""

import os
from struct import Struct

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from wheretolook.geometry.pose_files import (
    MAX_ROWS,
    POSE_COLUMNS,
    pose_texts,
    pose_values,
    poses_of_values,
    read_named_rows,
    read_rows,
    tum_text,
)
from wheretolook.geometry.poses import camera_centers, invert_poses, poses_looking_along, quaternion_from_rotation
from wheretolook.geometry.views import Views
from wheretolook.mapping.georeference import read_positions
from wheretolook.select.waypoints import read_waypoints
from wheretolook.utils.errors import TableError

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


FIRST, SECOND = pose_texts(POSES)
WXYZ = quaternion_from_rotation(invert_poses(POSES)[..., :3])
MATRICES = [" ".join(map(str, pose.ravel())) for pose in invert_poses(POSES)]


@pytest.mark.parametrize(
    "text",
    [
        f"a.jpg {FIRST}\nb.jpg {SECOND}\n",  # hloc's results
        f"1 {FIRST}\n2 {SECOND}\n",
        f"# id qw qx qy qz tx ty tz\na {FIRST}\nb {SECOND}\n",
        f"# camera_id\n1 {FIRST} 1 a.jpg\n2 {SECOND} 1 b.jpg\n",  # images.txt without lines of keypoints
        f"1 {FIRST} 1 a.jpg\n2 3 -1 5 6 7 8 9 -1\n2 {SECOND} 1 b.jpg\n\n",
        "#timestamp tx ty tz qx qy qz qw\n" + tum_text("12", POSES),
        f"{MATRICES[0]}\n{MATRICES[1]}\n",  # KITTI
        "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n"  # EuRoC
        + "".join("1,{4},{5},{6},{0},{1},{2},{3}\n".format(*WXYZ[row], *camera_centers(POSES)[row]) for row in (0, 1)),
        f"7 {MATRICES[0]} 0 0 0 1\n8 {MATRICES[1]} 0 0 0 1\n",
    ],
)
def test_formats_are_recognized_by_their_content(text, tmp_path):
    for name in ("poses", "poses.csv", "poses.txt"):
        (tmp_path / name).write_text(text)
        assert_allclose(Views.read(tmp_path / name).cam_from_world, POSES, atol=1e-8)
        assert_allclose(read_waypoints(tmp_path / name).points, camera_centers(POSES), atol=1e-8)


def test_eight_columns_that_two_orders_fit(tmp_path):
    path = tmp_path / "poses"
    for text in ("1 1 0 0 0 0 0 1\n", "a.jpg 1 2 3 0 0 0 1\n", "1 1 2 3 4 5 6 7\n"):
        path.write_text(text)
        for read in (Views.read, read_waypoints):
            with pytest.raises(TableError, match="unit quaternions"):
                read(path)


def test_four_columns_are_a_name_and_a_location_not_a_yaw(tmp_path):
    path = tmp_path / "positions.txt"
    for text in ("1.5 2 1 90\n0.5 2 1 45\n", "2 2 1 90\n2 3 1 45\n"):
        path.write_text(text)
        with pytest.raises(TableError, match="yaw"):
            read_waypoints(path)
        path.write_text("# x y z yaw_deg\n" + text)
        assert_allclose(read_waypoints(path).heading_deg(np.eye(3)), [90, 45])
    for first, second in (("7", "3"), ("0.25", "0.5"), ("a.jpg", "2")):  # numbers, times, names
        path.write_text(f"{first} 1 2 3\n{second} 4 5 6\n")
        waypoints = read_waypoints(path)
        assert_allclose(waypoints.points, [(1, 2, 3), (4, 5, 6)])
        assert waypoints.ids == (first, second)


def test_binary_images_and_folders_of_models(tmp_path):
    images = b"".join(
        Struct("<I7dI").pack(row, *pose, 1) + name + b"\0" + Struct("<Q2dQ").pack(1, 3.0, 4.0, 5)
        for row, (pose, name) in enumerate(zip(pose_values(POSES).tolist(), (b"a.jpg", b"b c.jpg"), strict=True))
    )
    path = tmp_path / "images.bin"
    path.write_bytes(Struct("<Q").pack(2) + images)
    for given in (path, tmp_path):
        views = Views.read(given)
        assert views.waypoint_id == ("a.jpg", "b c.jpg")
        assert_allclose(views.cam_from_world, POSES, atol=1e-12)
    for content in (b"", path.read_bytes()[:-1], Struct("<Q").pack(2**63) + images, Struct("<Q").pack(1) + images):
        path.write_bytes(content)
        with pytest.raises(TableError, match="cannot be read"):
            Views.read(path)
    path.unlink()
    with pytest.raises(TableError):
        Views.read(tmp_path)


def test_poses_of_a_base_look_along_x(tmp_path):
    path = tmp_path / "base.tum"
    path.write_text("0 1 2 3 0 0 0 1\n")
    table = read_named_rows(path)
    for frame, axis in ((None, (1, 0, 0)), ("base", (1, 0, 0)), ("camera", (0, 0, 1))):
        views = Views.of_rows(table, frame=frame)
        assert_allclose(views.axes, [axis], atol=1e-12)
        assert ("base" in views.read_as[0]) == (axis[0] == 1)
        heading = read_waypoints(path, frame).heading_deg(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]))
        assert_allclose(heading, [90 if axis[0] == 1 else 0])


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
        with pytest.raises(TableError, match="16,000,000 bytes"):
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
