"""Labels of a room whose answers are known: a plain wall never localizes, a poster wall in the map always does."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from mapping.conftest import ROOM_SIZE, BoxFreeSpace, box_room
from wheretolook.errors import MapError, SceneError
from wheretolook.geometry import PinholeCamera, poses_looking_along
from wheretolook.labelling import LabelConfig, Localizer, LocalizerConfig, label_viewpoints
from wheretolook.labelling.shard import label_rows
from wheretolook.mapping.building import MapConfig, build_map
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.rendering import MeshRaycaster, WarpRenderer
from wheretolook.scenes.loading import load_mesh, save_glb
from wheretolook.table import SCHEMA, UNLABELLED, is_good, pose_columns

CAMERA = PinholeCamera(320, 240, 160.0)
PLAIN = 1  # the face x = high of `box_room`
POSTER = 0  # the face x = 0


@dataclass(frozen=True)
class MappedRoom:
    """A room with one plain wall, and its map."""

    mesh: Path
    landmarks: Path


def map_room(folder: Path, texture_scale: float) -> MappedRoom:
    mesh = box_room()
    textures = list(mesh.textures)
    textures[PLAIN] = np.full_like(textures[PLAIN], 200)
    mesh = replace(mesh, textures=tuple(textures), corner_uvs=mesh.corner_uvs * np.float32(texture_scale))
    save_glb(mesh, folder / "mesh.glb")
    mesh = load_mesh(folder / "mesh.glb")
    build_map(
        mesh, WarpRenderer(mesh), BoxFreeSpace(), CAMERA, MapConfig(n_images=24), seed=0, out_dir=folder / "map",
        raycaster=MeshRaycaster(mesh), workers=1, progress=False,
    )  # fmt: skip
    return MappedRoom(folder / "mesh.glb", folder / "map" / "landmarks.npz")


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> MappedRoom:
    """No texture repeats: the room is 5 m long, and so is a texture."""
    return map_room(tmp_path_factory.mktemp("room"), texture_scale=0.5)


def viewpoints(locations: np.ndarray, directions: np.ndarray) -> pd.DataFrame:
    n = len(locations)
    columns = {name: np.zeros(n) for name in SCHEMA.names} | pose_columns(poses_looking_along(locations, directions))
    table = pd.DataFrame(columns).assign(viewpoint_id=np.arange(n), status=UNLABELLED, error_m=np.nan, error_deg=np.nan)
    return table.astype({"viewpoint_id": np.int64, "n_inliers": np.int32})


def facing(wall: int, n: int, distance_m: float, seed: int = 0) -> pd.DataFrame:
    """Views square to a wall x = const, near enough to see nothing but it."""
    rng = np.random.default_rng(seed)
    locations = np.column_stack([np.zeros(n), rng.uniform(1.6, 2.4, n), rng.uniform(1.2, 1.4, n)])
    locations[:, 0] = ROOM_SIZE[0] - distance_m if wall == PLAIN else distance_m
    return viewpoints(locations, np.tile([1.0 if wall == PLAIN else -1.0, 0, 0], (n, 1)))


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


def test_a_repeated_texture_localizes_at_the_wrong_copy_and_is_labelled_so(tmp_path: Path) -> None:
    """On the 4 m long wall the texture comes again after 2.5 m: some poses are off by just that, with many inliers."""
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


def test_workers_and_shards_do_not_change_the_table(room: MappedRoom, tmp_path: Path) -> None:
    table = pd.concat([facing(POSTER, 7, 1.5), facing(PLAIN, 6, 2.5, seed=1)], ignore_index=True)
    one, two = (
        label_viewpoints(table, room.mesh, room.landmarks, CAMERA, tmp_path / str(workers),
                         LabelConfig(workers=workers, shard_size=size), progress=False)
        for workers, size in ((1, 16), (2, 3))
    )  # fmt: skip
    pd.testing.assert_frame_equal(one, two)


def test_killed_at_any_moment_it_resumes_to_the_same_table(room: MappedRoom, tmp_path: Path) -> None:
    table = facing(POSTER, 24, 1.5)
    table.to_parquet(tmp_path / "table.parquet")
    script = tmp_path / "run.py"
    script.write_text(
        "import sys, pandas as pd\nfrom pathlib import Path\n"
        "from wheretolook.geometry import PinholeCamera\n"
        "from wheretolook.labelling import LabelConfig, label_viewpoints\n"
        "if __name__ == '__main__':\n"
        "    folder, mesh, landmarks = map(Path, sys.argv[1:])\n"
        "    table, camera = pd.read_parquet(folder / 'table.parquet'), PinholeCamera(320, 240, 160.0)\n"
        "    config = LabelConfig(workers=2, shard_size=2)\n"
        "    label_viewpoints(table, mesh, landmarks, camera, folder / 'shards', config, progress=False)\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    run = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path), str(room.mesh), str(room.landmarks)], env=environment
    )
    deadline = time.monotonic() + 120
    while len(list(tmp_path.glob("shards/*.parquet"))) < 3 and time.monotonic() < deadline and run.poll() is None:
        time.sleep(0.02)
    run.send_signal(signal.SIGKILL)
    run.wait()
    finished = sorted(tmp_path.glob("shards/*.parquet"))
    assert 3 <= len(finished) < 12
    time.sleep(2)  # its orphaned workers end themselves
    times = {path: path.stat().st_mtime_ns for path in finished}
    damaged = finished[0]
    damaged.write_bytes(damaged.read_bytes()[:100])

    arguments = table, room.mesh, room.landmarks, CAMERA
    config = LabelConfig(workers=1, shard_size=2)
    resumed = label_viewpoints(*arguments, tmp_path / "shards", config, progress=False)
    undisturbed = label_viewpoints(*arguments, tmp_path / "other", config, progress=False)
    pd.testing.assert_frame_equal(resumed, undisturbed)
    assert all(path.stat().st_mtime_ns == at for path, at in times.items() if path != damaged)


def test_an_error_in_a_worker_keeps_its_type(room: MappedRoom, tmp_path: Path) -> None:
    broken = tmp_path / "broken.glb"
    broken.write_bytes(b"no mesh")
    with pytest.raises(SceneError, match=r"broken\.glb"):
        label_viewpoints(facing(POSTER, 2, 1.5), broken, room.landmarks, CAMERA, tmp_path, progress=False)
    assert not multiprocessing.active_children()


def test_landmarks_without_descriptors_are_refused(room: MappedRoom, tmp_path: Path) -> None:
    bare = tmp_path / "landmarks.npz"
    replace(Landmarks.load(room.landmarks), descriptors=None).save(bare)
    with pytest.raises(MapError, match="without descriptors"):
        label_viewpoints(facing(POSTER, 2, 1.5), room.mesh, bare, CAMERA, tmp_path, progress=False)
