"""Two rooms alike: the pose with evidence of its own is chosen, though a wrong one has more inliers."""

import numpy as np
import pytest

from localization.test_joint import CAMERA, a_room
from wheretolook.geometry.poses import pose_error, poses_looking_along
from wheretolook.localization.estimation import PoseAmbiguity, PoseEstimator, most_likely, strongest_rival
from wheretolook.localization.rig import Look, rig_of
from wheretolook.localization.rig_localization import JointLocalizer

BEYOND = np.array([20.0, 0, 0])


def two_rooms():
    """Points (N, 3) of a room of 8 x 6 x 3 m and its copy 20 m off, and of a column that only the first has.

    Also rows of each: room, copy, column.
    """
    room = a_room(2000)
    column = np.column_stack([np.full((40, 2), (2.0, 0.5)), np.linspace(-1, 1, 40)])
    points = np.concatenate([room, room + BEYOND, column])
    return points, np.split(np.arange(len(points)), [2000, 4000])


def in_image(points, rows, pose):
    there = points[rows] @ pose[:, :3].T + pose[:, 3]
    pixels = CAMERA.project(np.where(there[:, 2:] > 0.1, there, (0, 0, 1)))
    seen = (there[:, 2] > 0.1) & CAMERA.in_image(pixels)
    return rows[seen], pixels[seen]


def test_unique_support_counts_landmarks_that_the_other_location_lacks():
    points, (room, copy, column) = two_rooms()
    here = poses_looking_along([[0.4, -0.7, 0.1]], [[1.0, 0.4, 0.0]])[0]
    there = poses_looking_along([[20.4, -0.7, 0.1]], [[1.0, 0.4, 0.0]])[0]
    ambiguity = PoseAmbiguity(points)
    assert ambiguity.unique_support(room, here, there) == ambiguity.unique_support(copy, there, here) == 0
    # 2 m of the column, in cubes of 0.25 m whose corners lie at multiples of that: the last point is in a ninth
    assert ambiguity.unique_support(column, here, there) == ambiguity.count_voxels(column) == 9
    # a turn of half a circle: the room is alike, the column is where there is nothing
    turned = poses_looking_along([[-0.4, 0.7, 0.1]], [[-1.0, -0.4, 0.0]])[0]
    assert ambiguity.unique_support(column, here, turned) == 9
    # 20 cm off a thing is the same thing
    near = poses_looking_along([[0.6, -0.7, 0.1]], [[1.0, 0.4, 0.0]])[0]
    assert ambiguity.unique_support(column, here, near) == 0


@pytest.mark.parametrize("n_column", [0, 12])
def test_unique_support_outweighs_inliers_that_both_rooms_explain(n_column):
    """Each of three looks matches 60 landmarks of the copy and 30 of the room that it sees. Without the
    column the rooms are indistinguishable and the copy has more inliers; a dozen matches of the column decide."""
    points, (room, _, column) = two_rooms()
    axes = [(1.0, 0.4, 0.0), (0.0, 1.0, 0.2), (-1.0, 0.3, -0.1)]
    poses = poses_looking_along(np.tile((0.4, -0.7, 0.1), (3, 1)), np.array(axes))
    rng = np.random.default_rng(1)
    looks = []
    for number, (pose, cam_from_rig) in enumerate(zip(poses, rig_of(poses), strict=True)):
        rows, pixels = in_image(points, room, pose)
        chosen = rng.choice(len(rows), 90, replace=False)
        landmarks = np.where(np.arange(90) < 60, rows[chosen] + len(room), rows[chosen])
        own, at = in_image(points, column, pose) if number == 0 else (column[:0], np.zeros((0, 2)))
        seen = np.concatenate([pixels[chosen], at[:n_column]])
        looks.append(Look(cam_from_rig, seen, np.concatenate([landmarks, own[:n_column]]), CAMERA))
    found = JointLocalizer(PoseEstimator(points)).localize(looks)
    right = poses if n_column else poses_looking_along(np.tile((20.4, -0.7, 0.1), (3, 1)), np.array(axes))
    assert pose_error(found.cams_from_world, right)[0].max() < 1e-3
    assert found.n_inliers == (90 + 12 if n_column else 180)
    assert found.unique_support[1] == 0 and (found.unique_support[0] > 0) == (n_column > 0)
    assert found.rival_support == pytest.approx(180 if n_column else 90, abs=1)


def test_the_pose_with_the_weakest_strongest_rival_is_selected():
    """The second beats the first, the third beats the second, and the first beats the third by far."""
    own = np.array([[0, 10, 50], [14, 0, 12], [12, 14, 0]])
    support = [300.0, 230.0, 33.0]
    assert [strongest_rival(own, support, k) for k in range(3)] == [1, 0, 0]
    assert most_likely(own, support) == 1
    assert most_likely(own[:1, :1], support[:1]) == 0 == most_likely(np.array([[0, 0], [50, 0]]), [300.0, 29.0])
    assert most_likely(np.array([[0, 0], [50, 0]]), [300.0, 31.0]) == 1
