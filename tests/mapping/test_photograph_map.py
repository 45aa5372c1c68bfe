"""A room with markers, mapped from its photographs alone and held against the truth; and the stages upon it."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose

from all_options import AllOptions, run
from mapping.marker_rooms import CAMERA, MARKERS, hand_held_poses, marker_room, take_photographs
from wheretolook.commands.label import Label
from wheretolook.commands.map import BuildMap
from wheretolook.commands.sample import Sample
from wheretolook.commands.viewpoint_map import BuildViewpointMap
from wheretolook.dataset.config import SampleConfig
from wheretolook.dataset.viewpoint_table import UNLABELLED, poses
from wheretolook.features.extractor import SIFT
from wheretolook.geometry.poses import camera_centers
from wheretolook.mapping import photograph_map as incremental
from wheretolook.mapping.colmap_model import colmap_poses, model_arrays, read_model
from wheretolook.mapping.config import FrameOptions, MarkerConfig, PhotographsConfig
from wheretolook.mapping.georeference import fit_similarity, median_depths
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map_folder import MapRun
from wheretolook.mapping.map_frame import read_frame
from wheretolook.mapping.photograph_map import map_photographs
from wheretolook.mapping.photographs import PhotographCameras
from wheretolook.scorers.visible import VisibleScorer
from wheretolook.space.config import MappedSpaceConfig
from wheretolook.utils.errors import MapError, SceneError
from wheretolook.utils.processes import WorkerPool

TRUTH = hand_held_poses()
CENTERS = camera_centers(TRUTH)
PARAMS = (CAMERA.focal_px, CAMERA.cx, CAMERA.cy)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photographs") / "room"
    take_photographs(marker_room(), TRUTH, folder)
    cv2.imwrite(str(folder / "photo-99.png"), np.random.default_rng(0).integers(0, 255, (360, 480, 3), dtype=np.uint8))
    return folder


def config_of(photographs, frame=FrameOptions(), **markers):
    known = MarkerConfig(**markers)
    camera = {"camera_model": "SIMPLE_PINHOLE", "camera_params": PARAMS}
    return PhotographsConfig(photographs, scale=known, frame=frame, **camera)


@pytest.fixture(scope="module")
def mapped(photographs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("mapped")
    config = config_of(photographs, marker_size_m=MARKERS[0].size_m)
    return folder, map_photographs(config, folder / "map", folder / "work", progress=False)


@pytest.fixture
def no_second_mapping(monkeypatch):
    """Fail where a finished step is done again."""

    def again(*arguments, **named):
        raise AssertionError("done again")

    for name in ("_extract", "match_pairs", "_reconstruct"):
        monkeypatch.setattr(incremental, name, again)


def test_photographs_are_placed_at_their_true_scale_and_upright(mapped, photographs):
    folder, report = mapped
    assert report.n_images == len(TRUTH) + 1 and report.n_registered == len(TRUTH)
    assert report.unregistered == ["photo-99.png"] and report.model_sizes == [len(TRUTH)]
    centers = camera_centers(colmap_poses(folder / "map"))
    similarity = fit_similarity(centers, CENTERS)
    assert similarity.scale == pytest.approx(1, abs=0.01)
    assert np.degrees(np.arccos(similarity.rotation[2, 2])) < 2  # z of the map against true z
    assert np.linalg.norm(similarity.apply(centers) - CENTERS, axis=1).max() < 0.02
    assert_allclose(centers.mean(0), 0, atol=1e-6)


def test_the_map_is_as_any_other(mapped):
    folder, report = mapped
    landmarks = Landmarks.load(folder / "map" / "landmarks.npz")
    assert len(landmarks) == report.n_landmarks > 1000
    assert landmarks.descriptors is not None and (landmarks.track_length >= 2).all()
    model = pycolmap.Reconstruction(str(folder / "map"))
    assert model.num_reg_images() == len(TRUTH) and model.num_points3D() == len(landmarks)
    (camera,) = model.cameras.values()
    assert tuple(camera.params) == PARAMS  # given, and kept
    assert np.ptp([point.color for point in model.points3D.values()]) > 100
    content = json.loads((folder / "map" / "report.json").read_text())
    assert content["scale"]["source"] == "markers" and content["unregistered"] == ["photo-99.png"]
    assert "images" in content["config"]["photographs"]


@pytest.mark.usefixtures("no_second_mapping")
def test_other_sources_of_scale_reuse_the_mapping(mapped, photographs, tmp_path):
    folder, _ = mapped

    def scaled(**frame):
        return map_photographs(
            config_of(photographs, FrameOptions(**frame)), tmp_path / "map", folder / "work", progress=False
        )

    apart = float(np.linalg.norm(CENTERS[0] - CENTERS[10]))
    by_cameras = scaled(distance=("photo-00.png", "photo-10.png", apart))
    assert by_cameras.scale.source == "distance" and by_cameras.scale.residuals == {}
    assert fit_similarity(camera_centers(colmap_poses(tmp_path / "map")), CENTERS).scale == pytest.approx(1, abs=0.01)
    apart = float(np.linalg.norm(np.subtract(MARKERS[0].center, MARKERS[2].center)))
    by_markers = scaled(distance=("marker:3", "marker:11", apart))
    assert by_markers.scale.factor == pytest.approx(by_cameras.scale.factor, rel=0.01)

    table = tmp_path / "positions.csv"
    rows = "".join(f"photo-{index:02d}.png,{x},{y},{z}\n" for index, (x, y, z) in enumerate(CENTERS.tolist()))
    table.write_text("image,x,y,z\n" + rows)
    by_positions = scaled(positions=table)
    assert by_positions.scale.unit == "m" and max(by_positions.scale.residuals.values()) < 0.02
    assert_allclose(camera_centers(colmap_poses(tmp_path / "map")), CENTERS, atol=0.02)
    assert by_positions.gravity["method"] == "positions"

    unknown = scaled()
    assert unknown.scale.source == "unknown" and not unknown.scale.is_metric
    depth = median_depths(model_arrays(read_model(tmp_path / "map")), colmap_poses(tmp_path / "map"))
    assert np.median(depth) == pytest.approx(5, rel=0.01)  # landmarks were removed since
    frame = read_frame(tmp_path / "map")
    assert frame.world_from_map.scale == 1 and len(frame.doubts) == 1
    with pytest.raises(MapError):
        scaled(distance=("photo-00.png", "nowhere.png", 1.0))
    with pytest.raises(MapError):
        scaled(distance=("photo-00.png", "marker:40", 1.0))
    with pytest.raises(MapError):
        config = config_of(photographs, marker_size_m=0.4, dictionary="DICT_APRILTAG_36H11")
        map_photographs(config, tmp_path / "map", folder / "work", progress=False)


def test_a_street_along_the_viewing_direction_is_mapped_by_a_further_mapper(tmp_path):
    """COLMAP's own starting pairs exclude forward motion."""
    rng = np.random.default_rng(0)
    n = 8
    facades = np.column_stack([rng.choice([-1, 1], 900) * rng.uniform(5, 8, 900), rng.uniform(-6, 1.5, 900)])
    points = np.column_stack([facades, rng.uniform(3, 48, 900)])
    words = rng.gamma(0.5, size=(len(points), SIFT.dimension))
    words /= np.linalg.norm(words, axis=1)[:, None]
    stored = []
    for row in range(n):
        ahead = points[(points[:, 2] - row > 2) & (points[:, 2] - row < 30)] - (0, 0, row)
        pixels = ahead[:, :2] / ahead[:, 2:] * 1200 + (640, 480)
        inside = ((pixels > 0) & (pixels < (1280, 960))).all(1)
        seen = words[(points[:, 2] - row > 2) & (points[:, 2] - row < 30)][inside]
        stored.append(((pixels[inside] + rng.normal(0, 0.5, (len(seen), 2))).astype(np.float32), SIFT.store(seen)))
    names = [f"{row}.jpg" for row in range(n)]
    sizes = np.tile((1280, 960), (n, 1))
    features = incremental.PhotographFeatures(names, sizes, sizes, stored, [], "street", SIFT)
    camera = pycolmap.Camera(camera_id=1, model="SIMPLE_PINHOLE", width=1280, height=960, params=(1200, 640, 480))
    cameras = PhotographCameras([camera], np.zeros(n, np.int64), given=True)
    with WorkerPool(1) as processes:
        run = MapRun(PhotographsConfig(tmp_path), processes, progress=False)
        mapped = incremental.match_and_map(tmp_path, features, cameras, 10, run)
    assert mapped.mappers["incremental"] < n / 2 and max(mapped.mappers.values()) == mapped.model_sizes[0] == n
    placed = colmap_poses(tmp_path, mapped.model)
    steps = np.diff(camera_centers(placed), axis=0)
    assert_allclose(steps / np.linalg.norm(steps, axis=1).mean(), placed[:-1, 2, :3], atol=0.1)


def test_photographs_that_do_not_overlap_are_refused(tmp_path):
    rng = np.random.default_rng(1)
    for index in range(4):
        blobs = cv2.GaussianBlur(rng.normal(size=(240, 320, 3)), (0, 0), 3)
        cv2.imwrite(str(tmp_path / f"{index}.png"), np.clip(128 + 600 * blobs, 0, 255).astype(np.uint8))
    with pytest.raises(MapError):
        map_photographs(PhotographsConfig(tmp_path), tmp_path / "map", tmp_path / "work",
                        progress=False)  # fmt: skip
    assert not (tmp_path / "map").exists()


@pytest.fixture(scope="module")
def experiment(mapped, photographs, tmp_path_factory):
    """The map stage done, without a scale, from keypoints and matches found before."""
    experiment = AllOptions(
        name="photos",
        data=tmp_path_factory.mktemp("data"),
        device="cpu",
        source={"photographs": config_of(photographs)},
        sample=SampleConfig(grid=(6, 4, 3), directions=60, keep=10),
        mapped_space=MappedSpaceConfig(max_camera_distance_m=0.6),
    )
    shutil.copytree(mapped[0] / "work", experiment.root / "room" / "photographs")
    said = []
    run(BuildMap, experiment, said.append)
    assert any("scale unknown" in line for line in said) and any("photo-99.png" in line for line in said)
    return experiment


@pytest.mark.slow
def test_a_scene_of_photographs_is_sampled_and_scored_but_not_labelled(experiment):
    scale = MarkerConfig(marker_size_m=MARKERS[0].size_m)
    photographs = replace(experiment.source["photographs"], scale=scale)
    metric = replace(experiment, source={"photographs": photographs})
    said = []
    run(BuildMap, metric, said.append)
    assert any("scale: markers" in line for line in said)
    dataset = run(Sample, metric, said.append)
    assert any("occlusion by hidden-points" in line for line in said)
    (scene,) = dataset.scenes
    table = scene.read_table()
    assert (
        table["location_id"].nunique() > 5 and (table["n_visible"] > 0).all() and (table["status"] == UNLABELLED).all()
    )
    views = poses(table)
    to_cameras = np.linalg.norm(camera_centers(views)[:, None] - camera_centers(scene.mapping_poses()), axis=2).min(1)
    assert to_cameras.max() <= 0.6
    localization_map = scene.localization_map(dataset.camera)
    shares = VisibleScorer(localization_map).score(views)
    assert_allclose(shares * len(localization_map.landmarks), table["n_visible"], atol=2)
    with pytest.raises(SceneError):
        run(Label, metric)
    said.clear()
    views_of_map = {"grid": (6, 4, 3), "directions": 40, "method": "visible"}
    (found,) = run(BuildViewpointMap, replace(metric, views=views_of_map), said.append).values()
    assert found.origin.occlusion == "hidden-points" and set(found.voxel_of_row) <= set(table["location_id"])
    best = found.best(camera_centers(views)[0])
    assert best.n_visible > 0
    run(BuildMap, metric, said.append)
    run(Sample, metric, said.append)
    assert sum("reusing" in line for line in said) == 2
