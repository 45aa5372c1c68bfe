"""Labels of a room whose answers are known: a plain wall never localizes, a poster wall in the map always does."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from localization.rooms import CAMERA, PLAIN, POSTER, facing, file_bytes, label, labelled, map_room, times
from localization.test_joint import in_view
from wheretolook.commands.options import MeshSource, ScenesConfig
from wheretolook.commands.scenes import Scenes
from wheretolook.dataset.viewpoint_files import FIRST_FIELDS, MATCH_FIELDS, SCHEMA, read_table, write_table
from wheretolook.dataset.viewpoint_table import LOCALIZED, TOO_FEW_MATCHES, is_good, poses, with_first_labels
from wheretolook.features.extractor import ExtractorConfig, Keypoints
from wheretolook.features.matches import Matches
from wheretolook.geometry.camera import ColmapCamera, PinholeCamera
from wheretolook.geometry.poses import pose_error, transform
from wheretolook.localization import shard
from wheretolook.localization.config import LabelConfig, LocalizerConfig
from wheretolook.localization.labeller import MANIFEST, LabelTask, label_scenes
from wheretolook.localization.localizer import Localizer
from wheretolook.localization.shard import label_rows
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.rendering.warp_renderer import WarpRenderer
from wheretolook.scenes.loading import load_mesh, save_glb
from wheretolook.utils.errors import ConfigError, SceneError, TableError
from wheretolook.utils.processes import cores


@pytest.mark.usefixtures("in_this_process")
def test_a_plain_wall_never_localizes_and_a_poster_wall_always_does(room, tmp_path):
    for wall, expected in ((PLAIN, 0.0), (POSTER, 1.0)):
        table = labelled(facing(wall, 12, distance_m=1.1), room, tmp_path, workers=1)
        assert is_good(table).mean() == expected
        if wall == PLAIN:
            assert table["error_m"].isna().all() and (table["n_inliers"] == 0).all()
        else:
            assert (table["n_inliers"] >= 10).all() and table["error_m"].max() < 0.05


def test_batches_that_exceed_the_memory_are_halved(room, views, expected, tmp_path, caplog):
    """A renderer and an extractor that fail, as on a full GPU, for more than three views give the same labels."""

    class SmallRenderer(WarpRenderer):
        def render(self, camera, cam_from_world):
            if len(cam_from_world) > 3:
                raise RuntimeError("Failed to allocate 1000 bytes on device 'cuda:0'")
            return super().render(camera, cam_from_world)

    localizer = Localizer(Landmarks.load(room.landmarks), CAMERA)
    whole = localizer.extractor.extract_batch

    def extract_batch(images):
        if len(images) > 3:
            raise RuntimeError("CUDA out of memory. Tried to allocate 1000 MiB")
        return whole(images)

    localizer.extractor.extract_batch = extract_batch
    with caplog.at_level("WARNING"):
        table = label_rows(views, room.job, localizer, SmallRenderer(load_mesh(room.mesh)))
    assert file_bytes(table, tmp_path / "halved") == expected
    assert "GPU memory does not suffice" in caplog.text

    def broken(images):
        raise RuntimeError("another error")

    localizer.extractor.extract_batch = broken
    with pytest.raises(RuntimeError, match="another error"):
        label_rows(views, room.job, localizer, WarpRenderer(load_mesh(room.mesh)))


@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_a_repeated_texture_localizes_at_the_wrong_copy_and_is_labelled_so(tmp_path):
    """On the 4 m long wall the texture repeats after 2.5 m: some poses are wrong by 2.5 m, with many inliers."""
    room = map_room(tmp_path, texture_m=2.5)
    table = labelled(facing(POSTER, 12, distance_m=1.1), room, tmp_path / "shards", workers=1)
    wrong = table["error_m"] > 0.1
    assert 0 < wrong.sum() < 12
    assert_allclose(table["error_m"][wrong], 2.5, atol=0.02)
    assert table["n_inliers"][wrong].min() > 50 and not is_good(table)[wrong].any()


def test_several_hypotheses_also_label_by_the_first_ransac_result(room, views, tmp_path):
    """The same renderings, localized by each method alone; of a plain wall there are too few matches, or a wrong pose."""
    renderer = WarpRenderer(load_mesh(room.mesh))
    landmarks = Landmarks.load(room.landmarks)
    first, both = (
        label_rows(views, room.job, Localizer(landmarks, CAMERA, LocalizerConfig(method)), renderer)
        for method in ("first", "hypotheses")
    )
    pd.testing.assert_frame_equal(with_first_labels(both)[[*first]], first)
    assert first["status"].nunique() > 1 and not both["n_inliers"].equals(first["n_inliers"])
    for compact in (False, True):
        write_table(both, tmp_path / "both.parquet", compact)
        stored = read_table(tmp_path / "both.parquet")
        assert [*stored] == [*SCHEMA.names, *FIRST_FIELDS.names]
        pd.testing.assert_frame_equal(with_first_labels(stored)[["status", "error_m"]], first[["status", "error_m"]])
    assert [*label_rows(stored, room.job, Localizer(landmarks, CAMERA), renderer)] == SCHEMA.names


def test_errors_are_measured_against_the_true_pose(room):
    """A table whose poses are wrong by 10 cm and 3 degrees gets exactly these errors."""
    table = facing(POSTER, 3, distance_m=1.5)
    localizer = Localizer(Landmarks.load(room.landmarks), CAMERA)

    class Elsewhere(WarpRenderer):
        def render(self, camera, cam_from_world):
            moved = np.array(cam_from_world)
            turn = np.radians(3.0)
            yaw = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
            moved[:, :, 3] += [0.0, 0.1, 0.0]  # 10 cm along the camera's y
            return super().render(camera, yaw @ moved)

    found = label_rows(table, room.job, localizer, Elsewhere(load_mesh(room.mesh)))
    assert_allclose(found["error_m"], 0.1, atol=0.02)
    assert_allclose(found["error_deg"], 3.0, atol=0.2)


@pytest.mark.parametrize(
    "camera",
    [
        PinholeCamera(640, 480, 300.0, 320.0, (310.0, 250.0)),
        ColmapCamera("OPENCV", 640, 480, (300.0, 305.0, 320.0, 240.0, -0.1, 0.02, 0.001, -0.002)),
        ColmapCamera("OPENCV_FISHEYE", 640, 480, (220.0, 221.0, 318.0, 242.0, 0.01, -0.002, 0.0, 0.0)),
        ColmapCamera("FOV", 640, 480, (300.0, 300.0, 320.0, 240.0, 0.9)),
    ],
    ids=lambda camera: getattr(camera, "model", "pinhole"),
)
def test_a_pose_is_found_with_every_camera(room, camera):
    """Half of the matches are wrong."""
    landmarks = Landmarks.load(room.landmarks)
    (pose,) = poses(facing(POSTER, 1, distance_m=1.5))
    rows, pixels = in_view(landmarks.points, pose, camera)
    rows = rows[:300]
    found = pixels[:300] + np.random.default_rng(0).normal(0, 0.3, (len(rows), 2))
    matched = rows.copy()
    matched[::2] = np.roll(matched[::2], 7)
    keypoints = replace(Keypoints.none(), pixels=found.astype(np.float32))
    matches = Matches.none(len(rows))._replace(keypoints=np.arange(len(rows)), landmarks=matched)
    estimate = Localizer(landmarks, CAMERA).estimate(keypoints, matches, camera)
    assert estimate.status == LOCALIZED
    (error_m,), (error_deg,) = pose_error(estimate.cam_from_world[None], pose[None])
    assert error_m < 0.02 and error_deg < 0.3 and len(estimate.inlier_rows) >= 0.4 * len(rows)


@pytest.mark.parametrize(
    ("there", "place", "options"),
    [
        (True, "cuda:0", {}),
        (False, "cpu", {}),
        (False, "cuda", {"extractor": ExtractorConfig("colmap")}),
        (False, "cuda", {"extractor": ExtractorConfig("aliked")}),
        (False, "cuda", {"appearance": 0.6}),
        (
            False,
            "cuda",
            {"cameras": ((0, CAMERA), (1, ColmapCamera("FOV", 640, 480, (300.0, 300.0, 320.0, 240.0, 0.9))))},
        ),
    ],
)
def test_one_process_owns_a_gpu_if_all_steps_run_there(room, there, place, options):
    job = replace(room.job, device=place, **options)
    assert job.on_gpu == there
    assert job.processes == (1 if there else cores())


@pytest.mark.parametrize("name", ["SpawnProcess-3", "SpawnProcess-1:3"])
def test_processes_of_a_pool_select_gpus_by_their_number(name, monkeypatch):
    """Also where the parent of the pool is itself a process of another."""
    monkeypatch.setattr(shard, "_worker", None)
    monkeypatch.setattr(shard, "current_process", lambda: SimpleNamespace(name=name))
    monkeypatch.setattr(shard.ShardWorker, "label", lambda self, job, rows: self.number)
    assert shard._label_shard(shard.Shard(None, None, None)) == 3


def test_views_of_several_cameras_are_labelled_as_each_alone(room):
    cameras = {4: CAMERA, 9: PinholeCamera(240, 320, 200.0, center_px=(118.0, 166.0))}
    table = facing(POSTER, 8, distance_m=1.5).assign(camera_id=np.array([4, 9, 9, 4, 4, 4, 9, 4], np.int32))
    renderer = WarpRenderer(load_mesh(room.mesh))
    localizer = Localizer(Landmarks.load(room.landmarks), CAMERA)
    together = label_rows(table, replace(room.job, cameras=tuple(cameras.items())), localizer, renderer)
    assert is_good(together).all() and together["viewpoint_id"].equals(table["viewpoint_id"])
    for number, camera in cameras.items():
        rows = table["camera_id"] == number
        job = replace(room.job, camera=camera)
        alone = label_rows(table[rows], job, Localizer(localizer.landmarks, camera), renderer)
        pd.testing.assert_frame_equal(together[rows], alone)


@pytest.mark.usefixtures("in_this_process")
def test_appearances_depend_on_the_view_alone(room, views, tmp_path):
    """Not on shards or an interruption; without them the table has no such column."""
    table = views.iloc[:12]
    shards = tmp_path / "shards"
    changed = label(table, room, shards, appearance=0.8, workers=1, shard_size=5)
    shard, *_ = times(shards)
    shard.unlink()
    assert label(table, room, shards, appearance=0.8, workers=1, shard_size=5) == changed
    assert label(table, room, tmp_path / "one", appearance=0.8, workers=1, shard_size=12) == changed
    back = read_table(tmp_path / "one-labelled.parquet")
    assert back["appearance"].between(0, 0.8).all() and back["appearance"].nunique() == 12
    clean = labelled(back, room, shards, workers=1)
    assert [*clean] == SCHEMA.names and is_good(clean).all()
    assert back["n_inliers"].sum() < clean["n_inliers"].sum()


@pytest.mark.usefixtures("in_this_process")
def test_half_of_the_locations_show_the_changed_mesh(room, tmp_path):
    """Labels are those of each mesh alone, whatever the shards; a location's views all show the same mesh."""
    table = facing(POSTER, 24, distance_m=1.5).assign(location_id=np.repeat(np.arange(12, dtype=np.int32), 2))
    mesh = load_mesh(room.mesh)
    plain = replace(mesh, textures=tuple(np.full_like(texture, 128) for texture in mesh.textures))
    save_glb(plain, tmp_path / "changed.glb")
    job = replace(room.job, changes=0.4, changed_mesh=tmp_path / "changed.glb")
    (one,), (other,) = (
        label_scenes(
            [LabelTask("room", job, table, tmp_path / str(size))], LabelConfig(workers=1, shard_size=size), False
        )
        for size in (5, 24)
    )
    assert one.manifest["changes"] == 0.4 and "changed_mesh" in one.manifest
    both = one.table
    pd.testing.assert_frame_equal(both, other.table)
    is_changed = both["changes"] > 0
    assert set(both["changes"]) == {np.float32(0), np.float32(0.4)} and 4 <= is_changed.sum() <= 20
    assert (both.groupby("location_id")["changes"].nunique() == 1).all()
    assert is_good(both)[~is_changed].all() and (both["n_inliers"][is_changed] == 0).all()
    localizer = Localizer(Landmarks.load(room.landmarks), CAMERA)
    alone = label_rows(table[~is_changed], room.job, localizer, WarpRenderer(mesh))
    pd.testing.assert_frame_equal(both[~is_changed].drop(columns="changes"), alone, check_dtype=False)
    again = label_rows(both, room.job, localizer, WarpRenderer(mesh))
    assert "changes" not in again and is_good(again).all()


def test_scenes_from_files_do_not_change(room, tmp_path):
    loaded = ScenesConfig(train=0, test=0, meshes=(MeshSource(room.mesh, name="room"),))
    scenes = Scenes(name="own", data=tmp_path, device="cpu", scenes=loaded)
    (files,) = scenes.run(log=lambda line: None).scenes
    with pytest.raises(SceneError, match=r"label\.changes") as error:
        scenes.change(files, 0.5)
    assert error.value.path == files.folder and "label.changes 0" in error.value.fix
    assert not (files.folder / "changed.glb").exists()


@pytest.mark.parametrize("name", ["changes", "appearance"])
@pytest.mark.parametrize("strength", [-0.1, 1.01, np.inf, np.nan])
def test_strengths_beyond_0_and_1_are_refused(name, strength):
    with pytest.raises(ConfigError, match=rf"label\.{name}"):
        LabelConfig(**{name: strength})


# Matched landmarks stored with the labels: their rows, and that nothing else changes.


def test_matched_rows_agree_with_the_labels(room, matched):
    n = len(Landmarks.load(room.landmarks))
    assert list(matched.columns) == [*SCHEMA.names, *MATCH_FIELDS.names]
    for view in matched.itertuples():
        assert view.matched_rows.dtype == view.inlier_rows.dtype == np.int32
        assert len(view.inlier_rows) == view.n_inliers <= len(view.matched_rows)
        assert (len(view.matched_rows) < 4) == (view.status == TOO_FEW_MATCHES)
        assert np.isin(view.inlier_rows, view.matched_rows).all()
        for rows in (view.matched_rows, view.inlier_rows):
            assert (np.diff(rows) > 0).all() and ((rows >= 0) & (rows < n)).all()
    lengths = matched["matched_rows"].map(len)
    assert lengths.min() == 0 and (lengths > matched["n_inliers"]).any() and matched["n_inliers"].max() > 50


def test_labels_are_the_same_with_and_without(views, matched, expected, tmp_path):
    assert file_bytes(matched.drop(columns=MATCH_FIELDS.names), tmp_path / "bare") == expected


@pytest.mark.usefixtures("in_this_process")
def test_shards_with_and_without_matches_have_names_of_their_own(room, tmp_path):
    """Shards without matches have the names and the manifest of versions that could not store matches."""
    table = pd.concat([facing(POSTER, 3, 1.5), facing(PLAIN, 1, 1.1)], ignore_index=True)
    table["viewpoint_id"] = np.arange(len(table))
    shards = tmp_path / "shards"
    label(table, room, shards, shard_size=4)
    (without,) = times(shards)
    settings = json.loads((shards / MANIFEST).read_text())
    assert settings["shards"] == {without.name: 4} and "store_matches" not in settings
    label(table, room, shards, shard_size=4, store_matches=True)
    both = times(shards)
    (stored,) = both.keys() - {without}
    expected = {**settings, "store_matches": True, "shards": {stored.name: 4}}
    assert json.loads((shards / MANIFEST).read_text()) == expected
    label(table, room, shards, shard_size=4)
    assert times(shards) == both


def test_pixels_are_kept_in_the_order_of_the_landmarks(room, views, matched, tmp_path):
    """Inliers of a good view are within RANSAC's limit of their projection at the true pose."""
    landmarks = Landmarks.load(room.landmarks)
    rows = np.flatnonzero(is_good(matched))[:4]
    localizer = Localizer(landmarks, CAMERA)
    renderer = WarpRenderer(load_mesh(room.mesh))
    some = views.iloc[rows].reset_index(drop=True)
    kept = label_rows(some, replace(room.job, store_pixels=True), localizer, renderer)
    write_table(kept, tmp_path / "viewpoints.parquet")
    back = read_table(tmp_path / "viewpoints.parquet", pixels=True)
    assert "matched_pixels" not in read_table(tmp_path / "viewpoints.parquet", matches=True)
    for row, pose in enumerate(poses(some)):
        np.testing.assert_array_equal(back["matched_rows"][row], matched["matched_rows"][rows[row]])
        pixels = back["matched_pixels"][row].reshape(-1, 2)
        assert pixels.dtype == np.float32 and len(pixels) == len(back["matched_rows"][row])
        inlier = np.isin(back["matched_rows"][row], back["inlier_rows"][row])
        at = CAMERA.project(transform(pose, landmarks.points[back["matched_rows"][row][inlier]]))
        assert np.linalg.norm(at - pixels[inlier], axis=1).max() < 10
    with pytest.raises(TableError):
        write_table(matched, tmp_path / "matches.parquet")
        read_table(tmp_path / "matches.parquet", pixels=True)
