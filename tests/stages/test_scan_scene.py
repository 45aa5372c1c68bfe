"""A recording of colour and depth goes through the stages like any other scene with a mesh."""

from __future__ import annotations

from dataclasses import replace

import pytest

from all_options import AllOptions, run
from scans.recordings import COLOR, room, walk, write_seven_scenes
from wheretolook.commands.map import Map
from wheretolook.commands.options import MeshSource, ScenesConfig
from wheretolook.commands.sample import Sample
from wheretolook.commands.scenes import Scenes
from wheretolook.dataset.config import SampleConfig
from wheretolook.dataset.layout import Dataset
from wheretolook.dataset.viewpoint_table import poses
from wheretolook.geometry.camera import CameraConfig
from wheretolook.geometry.poses import camera_centers
from wheretolook.mapping.config import MapConfig
from wheretolook.scans.config import RgbdConfig
from wheretolook.scenes.loading import save_glb
from wheretolook.utils.errors import MapWarning


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    write_seven_scenes(folder / "room", room(), walk())
    rgbd = RgbdConfig(folder=folder / "room", voxel_m=0.03, max_depth_m=5.0)
    few = SampleConfig(max_locations=4, max_directions=6, min_visible=1)
    scenes = ScenesConfig(rgbd=rgbd)
    return AllOptions(
        name="scan", data=folder / "data", device="cpu", scenes=scenes, mapping=MapConfig(n_images=30), sample=few
    )


def test_a_recording_is_mapped_and_sampled(experiment):
    said = []
    dataset = run(Scenes, experiment, said.append)
    (scene,) = dataset.scenes
    assert scene.name == "room" and scene.split == "test"
    assert (scene.camera, scene.own_camera) == (COLOR, True)  # the recording's, as none was named
    again: list[str] = []
    assert run(Scenes, experiment, again.append) == dataset == Dataset.load(experiment.root)
    assert "reusing" in again[0]

    with pytest.warns(MapWarning, match=r"room: mapping\.vary"):
        run(Map, replace(experiment, mapping=replace(experiment.mapping, vary=True)), said.append)
    run(Map, experiment, said.append)
    assert not scene.is_photographed and len(scene.read_landmarks()) > 200
    run(Sample, experiment, said.append)
    table = scene.read_table()
    assert table["location_id"].nunique() == 4 and (table["n_visible"] > 0).all()
    at = camera_centers(poses(table))
    assert ((at > 0) & (at < (3.6, 3.0, 2.4))).all()


def test_a_recording_joins_scenes_with_meshes_and_takes_a_named_camera(experiment, tmp_path):
    save_glb(room(), tmp_path / "loaded.glb")
    coarse = replace(experiment.scenes.rgbd, voxel_m=0.06, max_frames=20, appearance="colors")
    camera = CameraConfig(width=320, height=240, fov_deg=90)
    scan = replace(experiment, data=tmp_path, camera=camera, scenes=ScenesConfig(rgbd=coarse))
    mesh = ScenesConfig(train=0, test=0, meshes=(MeshSource(tmp_path / "loaded.glb", "train"),))
    run(Scenes, replace(scan, scenes=mesh))
    dataset = run(Scenes, scan)
    assert [(scene.name, scene.split) for scene in dataset.scenes] == [("loaded", "train"), ("room", "test")]
    assert {scene.camera for scene in dataset.scenes} == {camera.camera}
    before = dataset.scenes[1].mesh.stat().st_mtime_ns
    assert run(Scenes, replace(scan, scenes=mesh)) == dataset  # which does not name the scan
    assert dataset.scenes[1].mesh.stat().st_mtime_ns == before
