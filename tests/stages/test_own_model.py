"""A scene made from a COLMAP model, through the stages, with and without a mesh; and triangulated again."""

import json
from dataclasses import asdict, replace
from itertools import cycle

import numpy as np
import pandas as pd
import pycolmap
import pytest

from all_options import AllOptions, run
from box_scenes import box_quads, quads_mesh, random_texture
from colmap_models import colmap_model
from mapping.marker_rooms import CAMERA, MARKERS, hand_held_poses, marker_room, take_photographs
from wheretolook.cli import main
from wheretolook.commands.label import Label
from wheretolook.commands.map import BuildMap
from wheretolook.commands.options import extractor_of, select_options
from wheretolook.commands.sample import Sample
from wheretolook.commands.viewpoint_map import BuildViewpointMap
from wheretolook.dataset.config import SampleConfig
from wheretolook.dataset.layout import Dataset, SceneFolder
from wheretolook.dataset.scene import ColmapFiles, Scene
from wheretolook.features.extractor import ExtractorConfig
from wheretolook.geometry.camera import CameraConfig, PinholeCamera
from wheretolook.geometry.poses import camera_centers, poses_looking_along, transform
from wheretolook.geometry.similarity import Similarity
from wheretolook.geometry.views import Views
from wheretolook.mapping.colmap_model import colmap_poses, read_model
from wheretolook.mapping.config import FrameOptions, ImportConfig, MarkerConfig, PhotographsConfig
from wheretolook.mapping.imported_map import map_existing
from wheretolook.rendering.raycasting import MeshRaycaster
from wheretolook.scenes.loading import save_glb
from wheretolook.space.config import MappedSpaceConfig
from wheretolook.tracking import TrackingConfig
from wheretolook.utils.errors import ConfigError, MapError, MapWarning, SceneError, WeightsError

SIZE = (6.0, 5.0, 3.0)
LOOKS = PinholeCamera(320, 240, 200.0)
OTHER = PinholeCamera(160, 120, 80.0)


def empty_room():
    return quads_mesh(box_quads((0, 0, 0), SIZE, inward=True), [random_texture(np.random.default_rng(0), 64, 64)])


def room_model(cameras=(LOOKS,)):
    """Return a model of points on the walls of a room of `SIZE`, seen from 36 poses at a height of 1.4 m."""
    rng = np.random.default_rng(0)
    points = rng.uniform((0, 0, 0), SIZE, (800, 3))
    wall = rng.integers(0, 2, 800)  # which axis
    points[np.arange(800), wall] = rng.integers(0, 2, 800) * np.array(SIZE)[wall]
    angle = np.linspace(0, 2 * np.pi, 36, endpoint=False)
    centers = np.array([3.0, 2.5, 1.4]) + np.column_stack([1.6 * np.cos(angle), 1.2 * np.sin(angle), 0 * angle])
    poses = poses_looking_along(centers, np.column_stack([np.cos(3 * angle), np.sin(3 * angle), 0 * angle]))
    seen = []
    for pose, camera in zip(poses, cycle(cameras), strict=False):
        there = transform(pose, points)
        seen.append((there[:, 2] > 0) & camera.in_image(camera.project(there)))
    return colmap_model(points, poses, seen, cameras)


def save(model, folder):
    folder.mkdir(parents=True)
    model.write_text(str(folder))
    return folder


def experiment_of(model, data, **existing):
    return AllOptions(
        name="mine",
        data=data,
        device="cpu",
        mapped_space=MappedSpaceConfig(max_camera_distance_m=0.6),
        source={"model": model, "scale": 1, **existing},
        sample=SampleConfig(grid=(6, 5, 3), directions=40, keep=10, max_locations=6),
        views={"grid": (6, 5, 3), "directions": 30, "method": "visible"},
        tracking=TrackingConfig(str(data / "mlruns")),
    )


@pytest.mark.parametrize("with_mesh", [False, True])
def test_from_a_model_to_a_planned_path(tmp_path, with_mesh):
    model = room_model()
    folder = save(model, tmp_path / "flat" / "sparse" / "0")
    if with_mesh:
        save_glb(empty_room(), tmp_path / "scan.glb")
    experiment = experiment_of(folder, tmp_path / "data", mesh=tmp_path / "scan.glb" if with_mesh else None)
    run(BuildMap, experiment)
    (scene,) = Dataset.load(tmp_path / "data" / "mine").scenes
    assert scene.name == "flat" and scene.camera == LOOKS and scene.own_camera
    assert scene.is_photographed is not with_mesh and len(scene.read_landmarks()) == model.num_points3D()
    assert Scene(scene).map.has_photographs  # of the model, whose mesh is not what was mapped
    np.testing.assert_allclose(scene.mapping_poses(), colmap_poses(folder), atol=1e-6)

    run(Sample, experiment)
    table = scene.read_table()
    assert table["location_id"].nunique() == 6 and (table["n_visible"] > 0).all()
    (views,) = run(BuildViewpointMap, experiment).values()
    free = views.grid.centers()[views.row_of_voxel >= 0]
    to_cameras = np.linalg.norm(free[:, None] - camera_centers(colmap_poses(folder)), axis=2).min(1)
    assert (to_cameras.max() <= 0.6) is not with_mesh  # a mesh frees the whole room
    assert views.origin.occlusion == ("mesh" if with_mesh else "hidden-points")
    with pytest.raises(MapError if with_mesh else SceneError):
        run(Label, experiment)

    said = []
    run(BuildMap, experiment, said.append)
    run(Sample, experiment, said.append)
    assert sum("reusing" in line for line in said) == 2


@pytest.mark.parametrize("unit_m", [1, 0.1])
def test_one_command_plans_a_path_in_the_folder_of_a_model(tmp_path, capsys, unit_m):
    model = room_model()
    model.transform(pycolmap.Sim3d(1 / unit_m, pycolmap.Rotation3d(), np.zeros(3)))
    folder = save(model, tmp_path / "flat" / "sparse" / "0")
    where = ["--map", str(folder), "--scale", str(unit_m), "--data", str(tmp_path / "data"), "--device", "cpu"]
    start, goal = ([value / unit_m for value in point] for point in ((4.5, 2.5, 1.5), (4.5, 3.5, 1.5)))
    lattice = "--plan.grid=[6,5,3] --plan.directions=30 --method=visible --plan.planner.time_s=0.5 --film=none"
    out = ["--out", str(tmp_path / "way"), "--tracking.folder", str(tmp_path / "mlruns")]
    assert main(["plan", *where, "--start", str(start), "--goal", str(goal), *lattice.split(), *out]) == 0
    path = pd.read_csv(tmp_path / "way" / "path.csv")
    np.testing.assert_allclose(path.iloc[[0, -1], :3], [start, goal], atol=1e-6)
    centers = camera_centers(Views.read(tmp_path / "way" / "path.csv").cam_from_world)
    np.testing.assert_allclose(centers, path.iloc[:, :3], atol=1e-5)
    assert "320 x 240" in capsys.readouterr().out  # the model's camera
    lattice = "--method=visible --viewpoint-map.grid=[6,5,3] --viewpoint-map.directions=30"
    assert main(["viewpoint-map", *where, "--out", str(tmp_path / "flat.map"), *lattice.split()]) == 0
    assert "reusing" in capsys.readouterr().out
    assert main(["sample", *where, "--sample.grid", "[6, 5, 3]", "--sample.max_locations", "3"]) == 0
    (scene,) = Dataset.load(tmp_path / "data" / "flat").scenes
    assert scene.camera == LOOKS and scene.read_table()["location_id"].nunique() == 3


def test_a_scene_is_replaced_by_no_other_source(tmp_path):
    data = tmp_path / "data"
    (scene,) = run(BuildMap, experiment_of(save(room_model(), tmp_path / "flat"), data)).scenes
    content = (scene.map / "points3D.bin").read_bytes()
    other = save(room_model(cameras=(OTHER,)), tmp_path / "other" / "flat")
    (tmp_path / "photos" / "flat").mkdir(parents=True)
    photographs = {"photographs": PhotographsConfig(tmp_path / "photos" / "flat")}
    for experiment in (
        experiment_of(other, data),
        replace(experiment_of(other, data), source=photographs),
        experiment_of(scene.map, data, scene=scene.name),  # the scene's own map
    ):
        with pytest.raises(ConfigError, match=r"made from another source|would be replaced"):
            run(BuildMap, experiment)
    assert (scene.map / "points3D.bin").read_bytes() == content


def test_a_mesh_is_turned_and_must_overlap_with_the_map(tmp_path):
    folder = save(room_model(), tmp_path / "flat")
    mesh = empty_room()
    point = [[3.0, 2.5, 1.5]]
    expected = MeshRaycaster(mesh).distance_to_surface(point, 10.0)
    y_up = Similarity(1.0, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.zeros(3))
    save_glb(mesh.transformed(y_up), tmp_path / "y.glb")
    save_glb(mesh.transformed(Similarity(1.0, np.eye(3), np.array([0, 40.0, 0]))), tmp_path / "far.glb")
    files = ColmapFiles(folder, tmp_path / "y.glb", frame=FrameOptions(scale=1, up="z"))
    for name in ("y.glb", "far.glb"):
        with pytest.raises(SceneError, match="overlap"):
            _ = Scene(replace(files, mesh=tmp_path / name)).mesh_space
    imported = experiment_of(folder, tmp_path / "data", mesh=tmp_path / "far.glb")
    with pytest.raises(SceneError, match="overlap"):
        run(BuildMap, imported)
    assert not (tmp_path / "data" / "mine" / "flat" / "map").exists()  # before the import
    turned = Scene(replace(files, mesh_up="y")).raycaster
    np.testing.assert_allclose(turned.distance_to_surface(point, 10.0), expected, atol=1e-5)


def test_one_of_several_cameras_is_chosen(tmp_path):
    folder = save(room_model(cameras=(LOOKS, OTHER)), tmp_path / "flat")
    with pytest.raises((ConfigError, MapError)):
        run(BuildMap, experiment_of(folder, tmp_path / "data"))
    (scene,) = run(BuildMap, experiment_of(folder, tmp_path / "data", camera_id=2)).scenes
    assert scene.camera == OTHER
    sampled = select_options(Sample, experiment_of(folder, tmp_path / "sampled"))
    sampled = replace(sampled, name="mine", map=folder, scale=1, camera_id=2)
    assert sampled.run().scenes[0].camera == OTHER
    named = replace(experiment_of(folder, tmp_path / "data"), camera=CameraConfig(400, 300, fov_deg=80.0))
    (scene,) = run(BuildMap, named).scenes
    assert scene.camera == named.camera.camera and not scene.own_camera
    with pytest.raises(ConfigError):
        run(Sample, experiment_of(folder, tmp_path / "data"))
    # each model that joins the dataset keeps its own camera
    experiment = experiment_of(save(room_model(), tmp_path / "second"), tmp_path / "more")
    run(BuildMap, replace(experiment, source=experiment_of(folder, tmp_path / "more", camera_id=2).source))
    scenes = run(BuildMap, experiment).scenes
    assert [(scene.name, scene.camera) for scene in scenes] == [("flat", OTHER), ("second", LOOKS)]
    run(Sample, experiment)
    assert all(len(scene.read_table()) for scene in scenes)


def test_a_turned_and_scaled_model_warns_and_is_aligned(tmp_path):
    model = room_model()
    centers = camera_centers(colmap_poses("", model))
    turn = pycolmap.Rotation3d(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
    model.transform(pycolmap.Sim3d(37.0, turn, np.array([5.0, 0, 0])))
    flat = save(model, tmp_path / "flat")
    metric = FrameOptions(scale=1, up="z")
    with pytest.warns(MapWarning) as warned:
        map_existing(ImportConfig(model=flat, frame=metric), tmp_path / "map", tmp_path / "work")
    assert len([warning for warning in warned if warning.category is MapWarning]) == 2

    distance = ("000.jpg", "018.jpg", float(np.linalg.norm(centers[0] - centers[18])))
    table = tmp_path / "positions.csv"
    table.write_text("image,x,y,z\n" + "".join(f"{i:03d}.jpg,{x},{y},{z}\n" for i, (x, y, z) in enumerate(centers)))
    markers = MarkerConfig(marker_size_m=0.4)
    with pytest.raises(ConfigError):  # no photographs to detect markers in
        map_existing(ImportConfig(model=flat, scale=markers), tmp_path / "map", tmp_path / "work")
    for frame in (FrameOptions(distance=distance, up="level"), FrameOptions(positions=table)):
        config = ImportConfig(model=flat, frame=frame)
        map_existing(config, tmp_path / "map", tmp_path / "work")  # warnings are errors here
        report = json.loads((tmp_path / "map" / "report.json").read_text())
        assert report["scale"]["factor"] == pytest.approx(1 / 37)
        aligned = camera_centers(colmap_poses(tmp_path / "map"))
        np.testing.assert_allclose(np.ptp(aligned[:, 2]), 0, atol=1e-6)  # all at one height again
        if frame.positions:
            np.testing.assert_allclose(aligned, centers, atol=1e-6)


@pytest.mark.slow
@pytest.mark.filterwarnings("error::wheretolook.utils.errors.MapWarning")
def test_landmarks_are_triangulated_again_at_known_poses(tmp_path):
    """From poses alone, as of a robot or a phone: no points, photographs twice as large as the cameras say."""
    poses = hand_held_poses()
    model = pycolmap.Reconstruction()
    take_photographs(marker_room(), poses, tmp_path / "photos")
    half = replace(CAMERA, width=CAMERA.width // 2, height=CAMERA.height // 2, focal_px=CAMERA.focal_px / 2)
    model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=5, **half.colmap.record()))
    for index, pose in enumerate(poses):
        image = pycolmap.Image(name=f"photo-{index:02d}.png", camera_id=5, image_id=100 - index)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    folder = save(model, tmp_path / "flat")
    markers = MarkerConfig(marker_size_m=MARKERS[0].size_m)
    config = ImportConfig(tmp_path / "photos", scale=markers, model=folder, frame=FrameOptions(up="z"))
    report = map_existing(config, tmp_path / "map", tmp_path / "work", progress=False)
    assert report.retriangulated and report.has_descriptors and report.n_points == 0
    assert report.scale.source == "markers" and report.scale.factor == pytest.approx(1, abs=0.005)
    found = read_model(tmp_path / "map")
    assert found.num_points3D() == report.n_landmarks > 1000
    by_name = {image.name: image.projection_center() for image in found.images.values()}
    for index, center in enumerate(camera_centers(poses)):
        np.testing.assert_allclose(by_name[f"photo-{index:02d}.png"], report.scale.factor * center, atol=1e-6)
    points = np.array([point.xyz for point in found.points3D.values()])
    off_m = MeshRaycaster(marker_room()).distance_to_surface(points / report.scale.factor, 10.0)
    assert np.median(off_m) < 0.02


def test_weights_of_a_network_that_moved_since_the_map_was_made(tmp_path):
    """Queries are extracted with the file that is named now."""
    was = tmp_path / "was.pth"
    now = tmp_path / "now.pth"
    now.write_bytes(b"weights")
    made_with = ExtractorConfig("aliked", max_keypoints=500, weights=str(was))
    files = SceneFolder(tmp_path / "scene", "train")
    files.map.mkdir(parents=True)
    (files.map / "report.json").write_text(json.dumps({"config": {"extractor": asdict(made_with)}}))
    with pytest.raises(WeightsError):
        extractor_of(files, ExtractorConfig())
    named = ExtractorConfig("aliked", weights=str(now))
    assert extractor_of(files, named) == replace(made_with, weights=str(now))
    was.write_bytes(b"weights")
    assert extractor_of(files) == extractor_of(files, ExtractorConfig("xfeat", weights=str(now))) == made_with
