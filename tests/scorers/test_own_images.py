"""The offset of the log-odds of detection that a map's own images determine."""

import json
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from scipy.special import logit

from selection.room import WEIGHTS, write_room
from synthetic_dataset import make_landmarks
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.poses import camera_centers, poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.colmap_model import ModelArrays, select_points
from wheretolook.mapping.config import FrameOptions
from wheretolook.mapping.landmarks import Landmarks, load_colmap_landmarks
from wheretolook.mapping.map import Map
from wheretolook.robot.export import export_robot
from wheretolook.robot.wheretolook_robot import RobotScorer
from wheretolook.scorers.adapted.score import AdaptedNetwork
from wheretolook.scorers.set.network import SetNetwork
from wheretolook.scorers.set.score import OFFSETS, detection_offset, for_map
from wheretolook.scorers.weights import load_scorer
from wheretolook.training.trained_network import TrainedNetwork
from wheretolook.utils.errors import MapWarning
from wheretolook.visibility.occlusion import CachedOcclusion, OcclusionModel, StoredOcclusion

WIDE = PinholeCamera(640, 480, 320.0)
NARROW = PinholeCamera(640, 480, 640.0)
PREDICTED = 0.3


class SeesHalf(OcclusionModel):
    """Hides every second landmark."""

    def unoccluded(self, locations, points):
        return np.tile(np.arange(len(points)) % 2 == 0, (len(locations), 1))


class SeesNothing(OcclusionModel):
    """Hides all landmarks, as a mesh in another frame may."""

    def unoccluded(self, locations, points):
        return np.zeros((len(locations), len(points)), dtype=bool)


def bundled():
    return TrainedNetwork.load(WEIGHTS / "set.safetensors", SetNetwork, "set")


def constant_network():
    """Return a network that predicts the same probability of detection for every landmark."""
    network = deepcopy(bundled().network)
    last = network.matchability.layers[-1]
    assert isinstance(last, torch.nn.Linear)
    with torch.no_grad():
        last.weight.zero_()
        last.bias.fill_(logit(PREDICTED))
    return network


def observed_map(p_detect, n_images=40, n=2000, photographs=True):
    """Return a map whose images, of two cameras, observe each landmark in view with a probability."""
    rng = np.random.default_rng(0)
    landmarks = make_landmarks(rng, n)
    axes = rng.normal((1.5, 1.5, 0), 1, (n_images, 3))
    poses = poses_looking_along(rng.uniform((-2, -2, 1), (1, 1, 2), (n_images, 3)), axes)
    cameras = [WIDE if row % 3 else NARROW for row in range(n_images)]
    seen = np.zeros((n, n_images), dtype=bool)
    for row, camera in enumerate(cameras):
        local = landmarks.points @ poses[row, :, :3].T + poses[row, :, 3]
        pixels = camera.focal_px * local[:, :2] / local[:, 2:] + (320, 240)
        inside = (local[:, 2] > 0.1) & (pixels > 0).all(1) & (pixels < (640, 480)).all(1)
        seen[:, row] = inside & (rng.random(n) < p_detect)
    mapped = seen.sum(1) >= 2
    point, image = np.nonzero(seen[mapped])
    values = {name: v[mapped] if isinstance(v, np.ndarray) else v for name, v in vars(landmarks).items()}
    values["track_length"] = np.bincount(point).astype(np.int32)
    landmarks = Landmarks(**values)
    arrays = ModelArrays(
        point_ids=landmarks.ids,
        points=landmarks.points,
        errors_px=landmarks.reprojection_error_px.astype(np.float64),
        image_ids=np.arange(n_images),
        image_names=[f"{row}.jpg" for row in range(n_images)],
        image_poses=poses,
        image_centers=camera_centers(poses),
        image_cameras=np.arange(n_images) % 3,
        image_focal_px=np.array([camera.mean_focal_px for camera in cameras]),
        observation_start=np.concatenate([[0], np.cumsum(landmarks.track_length)]),
        observation_image=image,
        observation_keypoint=np.zeros(len(image), dtype=np.int64),
    )
    by_id = {0: NARROW, 1: WIDE, 2: WIDE}
    whole = Map(landmarks, poses, has_photographs=photographs, cameras=by_id, images=arrays)
    return LocalizationMap(whole, WIDE)


def with_images(localization_map, images):
    """Return a map with other images."""
    return replace(localization_map, map=replace(localization_map.map, images=images))


@pytest.mark.parametrize("p_detect", [0.2, 0.3, 0.6])
def test_the_offset_is_that_of_the_rate_of_detection(p_detect):
    """Whether a held-out image observes a landmark is independent of the others, so that the rate is known."""
    expected = logit(p_detect) - logit(PREDICTED)
    localization_map = observed_map(p_detect)
    offset, error = detection_offset(constant_network(), localization_map)
    assert offset == pytest.approx(expected, abs=0.12)
    n_observed = 0.4 * len(localization_map.map.images.observation_image)  # in 16 of 40 images
    assert error == pytest.approx(1 / np.sqrt(n_observed * (1 - p_detect)), rel=0.4)  # of a binomial's log-odds


def test_the_offset_is_bounded():
    assert detection_offset(constant_network(), observed_map(0.06, n=10_000))[0] == OFFSETS[0]
    assert detection_offset(constant_network(), observed_map(0.97))[0] == OFFSETS[-1]


def test_occluded_landmarks_determine_no_standard_error():
    localization_map = replace(observed_map(0.6, n=500), occlusion=SeesNothing())
    assert detection_offset(constant_network(), localization_map) == (OFFSETS[-1], None)


def test_few_images_do_not_determine_it():
    assert detection_offset(constant_network(), observed_map(0.6, n_images=4)) == (0, None)
    assert detection_offset(constant_network(), observed_map(0.6, n=3)) == (0, None)
    assert detection_offset(constant_network(), with_images(observed_map(0.6), None)) == (0, None)


def test_maps_that_do_not_show_it():
    """Stored occlusion is of all landmarks at other locations; no third image observes what two do."""
    localization_map = observed_map(0.6)
    images = localization_map.map.images
    n = len(localization_map.landmarks)
    stored = StoredOcclusion.from_mask(np.zeros((1, 3)), np.ones((1, n), dtype=bool))
    trained = replace(bundled(), network=constant_network())
    for occlusion in (stored, CachedOcclusion(stored)):
        unknown = for_map(trained, replace(localization_map, occlusion=occlusion)).network
        torch.testing.assert_close(unknown.state_dict(), trained.network.state_dict())
    pairs = replace(
        images,
        observation_start=2 * np.arange(n + 1),
        observation_image=np.tile([0, 1], n),
        observation_keypoint=np.zeros(2 * n, dtype=np.int64),
    )
    assert detection_offset(constant_network(), with_images(localization_map, pairs)) == (0, None)


def test_every_occlusion_model_has_its_own():
    localization_map = observed_map(0.6)
    half = replace(localization_map, occlusion=SeesHalf())
    offsets = [for_map(bundled(), one).network.matchability.layers[-1].bias.item() for one in (localization_map, half)]
    assert offsets[1] > offsets[0] + 0.5  # as many detections of half of the landmarks
    assert for_map(bundled(), half).network.matchability.layers[-1].bias.item() == offsets[1]


def test_it_is_added_for_photographs_only_and_to_a_copy():
    trained = replace(bundled(), network=constant_network())
    assert for_map(trained, observed_map(0.6, photographs=False)) is trained
    localization_map = observed_map(0.6)
    calibrated = for_map(trained, localization_map)
    noise_px = max(0.1, localization_map.landmarks.keypoint_noise_px)
    assert calibrated.of_map.error_scale == pytest.approx(noise_px)
    assert calibrated.of_map.log_error_scale_error is None  # without keypoints
    landmarks = localization_map.landmarks
    landmarks = replace(landmarks, reprojection_error_px=np.resize([np.nan, np.inf, 0.0], len(landmarks)))
    unknown = replace(localization_map, map=replace(localization_map.map, landmarks=landmarks))
    with pytest.warns(MapWarning, match="reprojection error"):
        assert for_map(trained, unknown).of_map.error_scale == pytest.approx(1.0)
    values = torch.zeros(5, len(trained.network.attributes))
    before, after = (one.network.matchability(values).sigmoid().numpy() for one in (trained, calibrated))
    assert_allclose(before, PREDICTED, rtol=1e-5)
    assert_allclose(after, 0.6, atol=0.03)


def test_all_scorers_of_a_map_use_it(tmp_path):
    """Of single poses, of directions, and on the robot."""
    localization_map = observed_map(0.6)
    views = localization_map.mapping_poses
    scorer = load_scorer(localization_map, WEIGHTS / "set.safetensors")
    plain = load_scorer(with_images(localization_map, None), WEIGHTS / "set.safetensors")
    before, after = (one.report(views).expected_inliers for one in (plain, scorer))
    assert (after[before > 1] > 1.1 * before[before > 1]).all()
    load_scorer(localization_map.of_camera(NARROW), WEIGHTS / "set.safetensors")
    assert sum(isinstance(key, tuple) for key in localization_map.map.computed) == 1  # estimated once
    axes = views[:1, 2, :3]
    center = camera_centers(views[:1])
    expected = scorer.score(poses_looking_along(center, axes))
    assert_allclose(scorer.score_directions(center, axes)[0], expected, atol=0.02)
    folder = export_robot(localization_map, WEIGHTS / "set.safetensors", tmp_path, progress=False)
    assert_allclose(RobotScorer(folder).score(views), scorer.score(views), atol=1e-5)
    calibration = json.loads((folder / "robot.json").read_text())["calibration"]
    report = replace(scorer.report(views[:1]), waypoint_id=("a",), rank=np.ones(1, dtype=np.int64))
    report.in_frame(localization_map.frame).save(tmp_path / "views.json")
    assert json.loads((tmp_path / "views.json").read_text())["calibration"] == calibration
    assert calibration["detection_offset"] == scorer.trained.of_map.detection_offset


def test_adapted_weights_state_what_they_store(tmp_path):
    localization_map = observed_map(0.6)
    base = for_map(bundled(), localization_map)
    network = AdaptedNetwork(base.network, base.scale, base.offset, 0, base.of_map.error_scale)
    path = tmp_path / "adapted.safetensors"
    TrainedNetwork("adapted", network, base.camera, 1.0, 0.0, base.training_range).save(path, {"scene": "room"})
    report = load_scorer(localization_map, path).report(localization_map.mapping_poses[:1])
    described = report.of_map.describe()
    assert f"{base.of_map.error_scale:.2f} px" in described and "nan" not in described and "offset" not in described
    report = replace(report, waypoint_id=("a",), rank=np.ones(1, dtype=np.int64))
    report.in_frame(localization_map.frame).save(tmp_path / "views.json")

    def refuse(constant):
        raise ValueError(f"{constant} is not JSON")

    calibration = json.loads((tmp_path / "views.json").read_text(), parse_constant=refuse)["calibration"]
    assert calibration.pop("error_scale") == pytest.approx(base.of_map.error_scale)
    assert set(calibration.values()) == {None}


def test_landmarks_without_an_image_are_those_of_the_smaller_model(tmp_path):
    folder = write_room(tmp_path / "sparse", metric=False)
    opened = Map.open(folder, frame=FrameOptions(scale=1.0, up="z"))
    images = opened.images
    assert len(images.image_ids) == 12
    model = pycolmap.Reconstruction(str(folder))
    for number in (2, 3, 7, 8, 12):
        model.deregister_frame(model.images[number].frame_id)
    expected = load_colmap_landmarks(folder, reconstruction=model)
    held_out = np.array([1, 2, 6, 7, 11])
    found = opened.without(images, held_out)
    few = select_points(images, images.point_ids <= images.point_ids[99])
    left = expected.ids[expected.ids <= images.point_ids[99]]
    assert_array_equal(opened.without(few, held_out).ids, left)
    assert len(expected) < len(opened.landmarks)
    assert_array_equal(found.ids, expected.ids)
    assert_array_equal(found.track_length, expected.track_length)
    for name in ("triangulation_angle_deg", "mapping_direction", "mapping_distance_m", "mapping_distance_spread"):
        assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-4)
