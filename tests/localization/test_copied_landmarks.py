"""Maps whose landmarks are all there twice: no match passes a ratio test against the copy."""

from dataclasses import replace

import numpy as np
import pytest

from holdout.corridor import write_corridor
from wheretolook.features.extractor import SIFT, Keypoints
from wheretolook.features.matches import has_twins
from wheretolook.features.matching import DescriptorMatcher
from wheretolook.geometry.camera import cameras_by_id
from wheretolook.geometry.poses import pose_error
from wheretolook.localization.confidence import RIGHT_PLACE
from wheretolook.localization.config import LocalizerConfig
from wheretolook.localization.localizer import Localizer
from wheretolook.localization.rig import Look, PosePrior, matches_among
from wheretolook.mapping.colmap_model import colmap_poses, read_model
from wheretolook.mapping.feature_files import read_features
from wheretolook.mapping.landmarks import load_colmap_landmarks

MOVED = np.array([0.0, 100.0, 0.0])


@pytest.fixture(scope="module")
def corridor(tmp_path_factory):
    """Landmarks, a camera, and the keypoints of photograph 010 with its pose."""
    sparse, database = write_corridor(tmp_path_factory.mktemp("corridor"))
    _, ((pixels, descriptors),) = read_features(database, ["010.jpg"])
    landmarks = load_colmap_landmarks(sparse, database, ambiguity=False)
    camera = cameras_by_id(read_model(sparse).cameras, sparse)[1]
    return landmarks, camera, Keypoints(pixels, SIFT.restore(descriptors)), colmap_poses(sparse)[10]


def twice(landmarks, moved):
    """Landmarks and their copies, moved by (3,) m."""
    values = {
        name: np.concatenate([value, value])
        for name, value in vars(landmarks).items()
        if isinstance(value, np.ndarray) and name != "points"
    }
    return replace(landmarks, **values, points=np.concatenate([landmarks.points, landmarks.points + moved]))


@pytest.mark.parametrize("moved", [np.zeros(3), MOVED])
def test_a_query_matches_landmarks_that_have_copies(corridor, moved):
    landmarks, camera, query, pose = corridor
    localizer = Localizer(twice(landmarks, moved), camera, LocalizerConfig(method="hypotheses"))
    (matches,) = localizer.match([query])
    assert len(matches.keypoints) > 50
    found = localizer.joint.localize([Look.of(query.pixels, matches, camera)])
    there = np.column_stack([pose[:, :3], pose[:, 3] - pose[:, :3] @ moved])
    errors = [pose_error(found.rig_from_world, each) for each in (pose, there)]
    assert min(errors)[0] < 0.02 and min(errors)[1] < 0.3
    certain = found.probabilities(RIGHT_PLACE)[0]
    assert certain > 0.9 if not moved.any() else certain < 0.6  # either place is as likely


def test_a_prior_is_a_hypothesis_where_nothing_matches_with_the_whole_map(corridor):
    landmarks, camera, query, pose = corridor
    copied = twice(landmarks, MOVED)
    localizer = Localizer(copied, camera, LocalizerConfig(method="hypotheses"))
    (matches,) = localizer.match([query])
    near = PosePrior(-pose[:, :3].T @ pose[:, 3] + 0.3).allows(copied.points, copied.mapping_distance_m, camera)
    of_prior = Look.of(query.pixels, matches_among(matches, near, 0.85), camera)
    nothing = matches._replace(keypoints=matches.keypoints[:0], landmarks=matches.landmarks[:0])
    look = Look.of(query.pixels, nothing, camera)
    assert localizer.joint.localize([look]).status == "too_few_matches"
    found = localizer.joint.localize([look], [localizer.joint.single_view_poses(of_prior, 1)])
    error_m, error_deg = pose_error(found.rig_from_world, pose)
    assert found.status == "localized" and error_m < 0.02 and error_deg < 0.3
    assert found.n_matches == len(of_prior.rows)


def test_repeated_texture_is_not_a_copy(corridor):
    landmarks, *_ = corridor
    descriptors = np.tile(landmarks.descriptors[:100], (8, 1))
    points = np.random.default_rng(0).uniform(-5, 5, (800, 3))
    assert not has_twins(DescriptorMatcher(descriptors), descriptors, points)
    assert not has_twins(DescriptorMatcher(landmarks.descriptors), landmarks.descriptors, landmarks.points)
