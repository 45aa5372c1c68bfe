"""Labels of a room whose answers are known: a plain wall never localizes, a poster wall in the map always does."""

from __future__ import annotations

import multiprocessing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from labelling.rooms import CAMERA, PLAIN, POSTER, MappedRoom, facing, map_room
from one_scene import label_viewpoints
from wheretolook.labelling.config import LabelConfig
from wheretolook.labelling.localizer import Localizer
from wheretolook.labelling.shard import label_rows
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh
from wheretolook.utils.errors import MapError, SceneError
from wheretolook.viewpoints.table import is_good


@pytest.mark.usefixtures("in_this_process")
def test_a_plain_wall_never_localizes_and_a_poster_wall_always_does(room: MappedRoom, tmp_path: Path) -> None:
    for wall, expected in ((PLAIN, 0.0), (POSTER, 1.0)):
        table = facing(wall, 12, distance_m=1.1)
        labelled = label_viewpoints(
            table, room.mesh, room.landmarks, CAMERA, tmp_path, LabelConfig(workers=1), progress=False
        )
        assert is_good(labelled).mean() == expected
        if wall == PLAIN:
            assert labelled["error_m"].isna().all() and (labelled["n_inliers"] == 0).all()
        else:
            assert (labelled["n_inliers"] >= 10).all() and labelled["error_m"].max() < 0.05


@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_a_repeated_texture_localizes_at_the_wrong_copy_and_is_labelled_so(tmp_path: Path) -> None:
    """On the 4 m long wall the texture repeats after 2.5 m: some poses are wrong by 2.5 m, with many inliers."""
    room = map_room(tmp_path, texture_scale=1.0)
    arguments = room.mesh, room.landmarks, CAMERA, tmp_path / "shards", LabelConfig(workers=1)
    labelled = label_viewpoints(facing(POSTER, 12, distance_m=1.1), *arguments, progress=False)
    wrong = labelled["error_m"] > 0.1
    assert 0 < wrong.sum() < 12
    np.testing.assert_allclose(labelled["error_m"][wrong], 2.5, atol=0.02)
    assert labelled["n_inliers"][wrong].min() > 50 and not is_good(labelled)[wrong].any()


def test_errors_are_measured_against_the_true_pose(room: MappedRoom) -> None:
    """A table that lies about a pose by 10 cm and 3 degrees gets exactly these errors."""
    table = facing(POSTER, 3, distance_m=1.5)
    localizer = Localizer(Landmarks.load(room.landmarks), CAMERA)

    class Elsewhere(WarpRenderer):
        def render(self, camera, cam_from_world):  # type: ignore[no-untyped-def]
            moved = np.array(cam_from_world)
            turn = np.radians(3.0)
            yaw = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
            moved[:, :, 3] += [0.0, 0.1, 0.0]  # 10 cm along the camera's y
            return super().render(camera, yaw @ moved)

    labelled = label_rows(table, Elsewhere(load_mesh(room.mesh)), localizer, CAMERA)
    np.testing.assert_allclose(labelled["error_m"], 0.1, atol=0.02)
    np.testing.assert_allclose(labelled["error_deg"], 3.0, atol=0.2)


@pytest.mark.slow
def test_an_error_in_a_worker_keeps_its_type(room: MappedRoom, tmp_path: Path) -> None:
    broken = tmp_path / "broken.glb"
    broken.write_bytes(b"no mesh")
    config = LabelConfig(workers=1)
    for path in (broken, tmp_path / "missing.glb"):
        with pytest.raises(SceneError, match=path.name):
            label_viewpoints(facing(POSTER, 2, 1.5), path, room.landmarks, CAMERA, tmp_path, config, progress=False)
    assert not multiprocessing.active_children()


def test_landmarks_without_descriptors_are_refused(room: MappedRoom, tmp_path: Path) -> None:
    bare = tmp_path / "landmarks.npz"
    replace(Landmarks.load(room.landmarks), descriptors=None).save(bare)
    with pytest.raises(MapError, match="without descriptors"):
        label_viewpoints(facing(POSTER, 2, 1.5), room.mesh, bare, CAMERA, tmp_path, progress=False)
