"""Landmarks that are hard to match are counted by their distance, angle, descriptor and line of sight."""

from dataclasses import replace

import numpy as np

from box_scenes import furnished_room
from selection.room import POINTS, write_room
from wheretolook.geometry.lattices import direction_lattice
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.inputs.landmark_features import ReasonCounter
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.scenes.loading import save_glb


def test_counts_by_the_definitions(tmp_path):
    save_glb(furnished_room(), tmp_path / "room.glb")
    room = LocalizationMap.from_colmap(write_room(tmp_path / "sparse"), mesh=tmp_path / "room.glb")
    mapped_m = room.landmarks.mapping_distance_m / 4  # so that some are twice as far
    mapped_along = np.roll(room.landmarks.mapping_direction, 1, axis=0)  # and some oblique
    ambiguity = np.linspace(0.9, 1.0, len(room.landmarks), dtype=np.float32)
    changed = {"mapping_distance_m": mapped_m, "mapping_direction": mapped_along, "ambiguity": ambiguity}
    room = replace(room, map=replace(room.map, landmarks=replace(room.landmarks, **changed)))
    axes = direction_lattice(12)
    poses = poses_looking_along(np.repeat(POINTS, 12, axis=0), np.tile(axes, (4, 1)))
    counts = ReasonCounter(room).count(poses)
    expected = np.zeros((len(poses), 4), dtype=int)
    for row, pose in enumerate(poses):
        local = room.landmarks.points @ pose[:, :3].T + pose[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = (320 * local[:, :2] / local[:, 2:] + (320, 240)).T
        in_image = (local[:, 2] > 0) & (x >= 0) & (x < 640) & (y >= 0) & (y < 480)
        visible = room.landmarks_in_view(pose[None])[0]
        rays = (local @ pose[:, :3])[visible]
        distance = np.linalg.norm(rays, axis=1)
        angle = np.degrees(np.arccos((rays * mapped_along[visible]).sum(1) / distance))
        hard = distance > 2 * mapped_m[visible], angle > 45, ambiguity[visible] > 0.95
        expected[row] = in_image.sum() - len(visible), *(reason.sum() for reason in hard)
    found = np.column_stack([counts.n_occluded, counts.n_too_far, counts.n_too_oblique, counts.n_repeated])
    np.testing.assert_array_equal(found, expected)
    assert (expected.sum(0) > 0).all()


def test_without_descriptors_repetition_is_unknown(tmp_path):
    room = LocalizationMap.from_colmap(write_room(tmp_path / "sparse"))
    counts = ReasonCounter(room).count(poses_looking_along(POINTS, np.tile((1.0, 0, 0), (4, 1))))
    assert np.isnan(counts.n_repeated).all() and (counts.n_occluded == 0).all() and (counts.n_too_far >= 0).all()
