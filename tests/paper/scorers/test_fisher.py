"""Fisher information as a way to choose views: where it must look, and what the scorers share."""

import numpy as np
import pytest

from paper.fisher.twins import eigenvalues_plain
from synthetic_dataset import make_landmarks
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import camera_centers, poses_looking_along
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.landmarks import Landmarks
from wheretolook.mapping.map import Map
from wheretolook.visibility.frustum import LandmarkSets, PosedViews
from wheretolook.visibility.occlusion import StoredOcclusion
from wheretolook_paper.fisher.exact import exact_information_plain
from wheretolook_paper.fisher.metrics import METRICS, metric_of_eigenvalues
from wheretolook_paper.scorers.fisher.score import FisherScorer, StationaryTraceScorer, WorstTraceScorer

CAMERA = PinholeCamera()
DIRECTIONS = fibonacci_sphere(300)


def with_points(points):
    landmarks = make_landmarks(np.random.default_rng(0), len(points))
    return Landmarks(**{**vars(landmarks), "points": points})


def two_walls(rng, n=1500):
    """Landmarks on the walls x = 4 and y = 4 of a room of 8 m x 8 m x 2.6 m."""
    points = rng.uniform((-4, -4, 0), (4, 4, 2.6), (n, 3))
    points[np.arange(n), rng.integers(0, 2, n)] = 4
    return with_points(points)


def views_at(locations, directions=DIRECTIONS):
    return poses_looking_along(np.repeat(locations, len(directions), 0), np.tile(directions, (len(locations), 1)))


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("approximation", ["exact", "quadratic", "gp"])
def test_of_a_room_with_landmarks_on_two_walls_it_looks_at_them(metric, approximation):
    rng = np.random.default_rng(1)
    localization_map = LocalizationMap(Map(two_walls(rng)), CAMERA)
    hits = 0
    for location in rng.uniform((-3, -3, 0.8), (2, 2, 1.8), (20, 3)):
        scores = FisherScorer(localization_map, metric, approximation).score(views_at(location[None]))
        best = DIRECTIONS[np.argmax(scores)]
        # on the ray from here along the axis one of the two walls comes first, not the others, floor or ceiling
        ahead = np.where(best > 0, 4 - location, -4 - location) / best
        ahead[2] = ((2.6 if best[2] > 0 else 0) - location[2]) / best[2]
        nearest = int(np.argmin(ahead))
        hits += nearest < 2 and best[nearest] > 0
        assert best[:2].sum() > 0.5, (location, best)
    assert hits >= 19  # a corner far off may be seen best with half a view of the floor


@pytest.mark.parametrize("about_origin", [False, True])
def test_exact_scores_are_metrics_of_the_sums(about_origin):
    rng = np.random.default_rng(3)
    landmarks = two_walls(rng, 400)
    locations = rng.uniform((-3, -3, 0.8), (2, 2, 1.8), (4, 3))
    mask = rng.random((4, 400)) < 0.6
    poses = views_at(locations, fibonacci_sphere(25))
    views = PosedViews(CAMERA, poses, landmarks.points, LandmarkSets.from_mask(mask), np.repeat(np.arange(4), 25))
    pivots = -camera_centers(poses) if about_origin else None
    values = eigenvalues_plain(exact_information_plain(views), pivots)
    seen = LocalizationMap(Map(landmarks), CAMERA, StoredOcclusion.from_mask(locations, mask))
    for metric in METRICS:
        scores = FisherScorer(seen, metric, "exact", about_origin).score(poses)
        np.testing.assert_allclose(scores, metric_of_eigenvalues(values, metric), rtol=1e-6, atol=1e-6)
        assert np.ptp(scores) > 0.1


def test_probes_look_away_from_the_landmarks():
    rng = np.random.default_rng(5)
    localization_map = LocalizationMap(Map(two_walls(rng)), CAMERA)
    locations = rng.uniform((-3, -3, 0.8), (2, 2, 1.8), (5, 3))
    poses = views_at(locations)
    for scorer in (WorstTraceScorer(localization_map), StationaryTraceScorer(localization_map)):
        scores = scorer.score(poses)
        assert np.all((scores >= 0) & (scores <= 1))
        best = DIRECTIONS[scores.reshape(5, -1).argmax(1)]
        # a probe defines one axis: the others' scores fall with the angle from it
        cosines = np.einsum("li,di->ld", best, DIRECTIONS)
        assert np.all([np.corrcoef(c, s)[0, 1] > 0.99 for c, s in zip(cosines, scores.reshape(5, -1), strict=True)])
        assert np.all(best[:, :2].sum(1) < 0)
