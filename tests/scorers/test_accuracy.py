"""Scores of the set network at any accuracy, against closed forms."""

import json
import math
import warnings

import numpy as np
import pycolmap
import pytest
from scipy.stats import lognorm

from selection.room import write_room
from synthetic_dataset import CAMERA, make_landmarks
from wheretolook.dataset.config import ACCURACY
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import direction_lattice, fibonacci_sphere
from wheretolook.geometry.poses import poses_looking_along
from wheretolook.geometry.similarity import Similarity
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.mapping.colmap_model import write_model
from wheretolook.mapping.map import Map
from wheretolook.scorers.registry import find, make_scorer
from wheretolook.scorers.set.accuracy import STATISTICS, AccuracyModel, LogError, PhotographModel
from wheretolook.scorers.set.score import SetScorer
from wheretolook.scorers.weights import load_scorer
from wheretolook.select.where_to_look import WhereToLook
from wheretolook.training.weights import read_header
from wheretolook.utils.errors import ConfigError, MapWarning, OutOfRangeWarning, WeightsError
from wheretolook.utils.package import WEIGHTS, shipped

ACCURACIES = ((1e-9, 1e-9), (0.01, 0.1), ACCURACY, (0.1, 1.0), (0.25, 2.0), (math.inf, math.inf))
DISTANCE_M = read_header(shipped(WEIGHTS) / "set.safetensors")["range"]["distance_m"]  # of the training views
MODEL = AccuracyModel((1.0, 0.5), 0.2, (LogError((0.1, 0.2, -0.3), -4.0, 0.9), LogError((0.0, 0.4, -0.1), -2.0, 0.8)))


def views(n=200):
    """Statistics as of views with few to many landmarks."""
    rng = np.random.default_rng(0)
    statistics = np.zeros((n, len(STATISTICS)))
    for name, low, high in (
        ("log_visible", 0, 7),
        ("log_position_variance", -8, 8),
        ("log_orientation_variance", -8, 8),
        ("log_expected_cells", 0, 5),
    ):
        statistics[:, STATISTICS.index(name)] = rng.uniform(low, high, n)
    return statistics


def p_within(statistics, accuracy):
    """F of `MODEL` by SciPy's log-normal distribution."""
    visible, position, orientation, cells = (
        statistics[:, STATISTICS.index(name)]
        for name in ("log_visible", "log_position_variance", "log_orientation_variance", "log_expected_cells")
    )
    median_m = np.exp(position / 2 + 0.1 * visible + 0.2 * orientation - 0.3 * cells - 4)
    median_deg = np.exp(0.4 * orientation - 0.1 * cells - 2)
    within = lognorm(0.9, scale=median_m).cdf(accuracy[0]), lognorm(0.8, scale=median_deg).cdf(accuracy[1])
    return np.minimum(*within)


def test_it_is_the_product_of_both_factors_where_the_network_is():
    statistics = views()
    place = np.random.default_rng(1).uniform(0.1, 0.9, len(statistics))
    own = place * p_within(statistics, ACCURACY)
    rows = np.flatnonzero(own > 1e-4)
    assert len(rows) > 20
    for row in rows:  # each by a model whose first factor is this view's, whatever the network's probability
        constant = AccuracyModel((0.0, 0.0), math.log(place[row] / (1 - place[row])), MODEL.errors)
        for accuracy in ((0.01, 0.1), (0.02, 3.0), (0.25, 2.0), (1.0, 10.0)):
            found = constant.at(accuracy, ACCURACY, own[row : row + 1], statistics[row : row + 1])
            assert found == pytest.approx(place[row] * p_within(statistics[row : row + 1], accuracy), abs=1e-9)


def test_it_rises_from_0_through_the_networks_own_probability_to_the_right_place():
    statistics = views()
    own = np.random.default_rng(2).uniform(0, 1, len(statistics))
    own[:2] = 0, 1
    found = np.stack([MODEL.at(accuracy, ACCURACY, own, statistics) for accuracy in ACCURACIES])
    assert (np.diff(found, axis=0) >= -1e-12).all() and (found >= 0).all() and (found <= 1).all()
    assert found[0] == pytest.approx(0, abs=1e-9)
    assert found[2] == pytest.approx(own, abs=1e-12)
    unsure = p_within(statistics, ACCURACY) < 1 - 1e-9
    place = np.maximum(own, MODEL.p_right_place(own, statistics))
    assert found[-1][unsure] == pytest.approx(place[unsure], abs=1e-9)


def test_errors_and_limits_scale_with_the_unit():
    statistics = views()
    larger = statistics.copy()
    larger[:, STATISTICS.index("log_position_variance")] += 2 * math.log(10)
    assert MODEL.quantiles(larger, (0.5, 0.4)) == pytest.approx(MODEL.quantiles(statistics, ACCURACY))
    assert MODEL.expected_errors(larger) == pytest.approx(MODEL.expected_errors(statistics) * (10, 1))


def test_on_photographs_it_is_the_product_of_both_factors_by_the_deviation_of_the_map():
    statistics = views()
    statistics[:, -2:] = np.random.default_rng(3).normal(-4, 1, (len(statistics), 2))
    own = np.random.default_rng(4).uniform(0.01, 0.99, len(statistics))
    model = PhotographModel((0.8,), 0.1, (LogError((), 0.9, 1.1), LogError((), 0.7, 1.0)))
    odds = (own / (1 - own)) ** 0.8 * np.exp(0.1)
    median_m, median_deg = np.exp(statistics[:, -2:] + (0.9, 0.7)).T
    for metres, degrees in ACCURACIES:
        within = lognorm(1.1, scale=median_m).cdf(metres), lognorm(1.0, scale=median_deg).cdf(degrees)
        found = model.at((metres, degrees), ACCURACY, own, statistics)
        assert found == pytest.approx(odds / (1 + odds) * np.minimum(*within), abs=1e-9)
    assert model.expected_errors(statistics) == pytest.approx(np.stack([median_m, median_deg], 1))


@pytest.mark.parametrize("kind", [AccuracyModel, PhotographModel])
def test_the_bundled_file_is_the_model_and_damage_is_found(tmp_path, kind):
    stored = json.loads(kind.file.read_text())
    model = kind.bundled()
    assert type(model) is kind and dict(zip(kind.names, model.weights, strict=True)) == stored["weights"]
    for error, name in zip(model.errors, ("position", "orientation"), strict=True):
        record = {**vars(error), "weights": dict(zip(kind.inputs, error.weights, strict=True))}
        assert record == stored["errors"][name]
    del stored["errors"]["position"]["bias"]
    (tmp_path / "accuracy.json").write_text(json.dumps(stored))
    with pytest.raises(WeightsError, match="damaged"):
        kind.load(tmp_path / "accuracy.json")


@pytest.fixture(scope="module", params=[False, True], ids=["renders", "photographs"])
def scorer(request):
    landmarks = make_landmarks(np.random.default_rng(0), 400)
    scorer = load_scorer(LocalizationMap(Map(landmarks, has_photographs=request.param), CAMERA))
    assert isinstance(scorer, SetScorer)
    return scorer


@pytest.fixture(scope="module")
def poses():
    return poses_looking_along(np.tile([0.0, 0.0, 1.5], (60, 1)), direction_lattice(60))


@pytest.mark.filterwarnings("ignore::wheretolook.utils.errors.OutOfRangeWarning")
def test_scores_rise_with_the_limits_and_are_unchanged_at_the_weights_own(scorer, poses):
    own = scorer.score(poses)
    found = [scorer.at_accuracy(accuracy).score(poses) for accuracy in ACCURACIES]
    assert np.array_equal(found[2], own) and scorer.at_accuracy(ACCURACY).name == "set"
    assert (np.diff(found, axis=0) >= 0).all() and found[4].mean() > own.mean() > found[1].mean()
    coarse = scorer.at_accuracy((0.25, 2.0))
    assert coarse.name == "set 0.25m_2deg" and find(coarse.name) is find("set")
    assert np.array_equal(coarse.at_accuracy(ACCURACY).score(poses), own)
    assert np.array_equal(coarse.report(poses).score, found[4])
    grid = coarse.score_directions(np.array([[0.0, 0.0, 1.5]]), direction_lattice(60))
    assert grid[0] == pytest.approx(found[4], abs=1e-3)


@pytest.mark.filterwarnings("ignore::wheretolook.utils.errors.OutOfRangeWarning")
def test_views_have_an_accuracy_and_expected_errors(scorer):
    look = WhereToLook(scorer, direction_lattice(60))
    place = [(0.0, 0.0, 1.5)]
    own = look.best(place)
    coarse = look.best(place, accuracy=(0.25, 2))
    assert coarse.score[0] >= own.score[0] and coarse.method == "set 0.25m_2deg"
    assert coarse.expected_error_deg is not None
    assert look.at_accuracy((0.25, 2)).score(coarse.cam_from_world) == pytest.approx(coarse.score, abs=1e-6)
    with pytest.raises(ConfigError, match="joint scores"):
        look.best(place, accuracy=(0.25, 2), looks=2)
    for limits in ((0, 1), (0.1, -1), (math.nan, 1), (1,)):
        with pytest.raises(ConfigError, match="accuracy"):
            look.best(place, accuracy=limits)
    visible = WhereToLook(make_scorer("visible", look.localization_map), direction_lattice(60))
    assert visible.best(place).expected_error_m is None
    with pytest.raises(ConfigError, match="visible"):
        visible.best(place, accuracy=(0.25, 2))


def sphere(radius_m):
    """The bundled scorer of landmarks on a sphere around the origin."""
    points = fibonacci_sphere(2000)
    landmarks = make_landmarks(
        np.random.default_rng(0), 2000, points=points * radius_m, triangulation_angle_deg=8,
        mapping_distance_m=radius_m, mapping_direction=-points,
    )  # fmt: skip
    scorer = load_scorer(LocalizationMap(Map(landmarks), PinholeCamera(400, 300, 200.0)))
    assert isinstance(scorer, SetScorer)
    return scorer


@pytest.mark.parametrize("radius_m", [6.0, 35.0])
def test_the_depth_that_is_in_range_depends_on_the_accuracy(radius_m):
    scorer = sphere(radius_m)
    farthest = DISTANCE_M[1]
    views = poses_looking_along(np.zeros((8, 3)), direction_lattice(8))
    for accuracy_m in (0.005, *(6 / DISTANCE_M[1] * 0.05 + np.array([-1e-4, 1e-4])), 0.05, 0.25, 1.0):
        at = scorer.at_accuracy((accuracy_m, 0.4))
        is_inside = radius_m < farthest and radius_m / accuracy_m < farthest / 0.05
        assert (at.in_range(views) == is_inside).all() and (at.report(views).in_range == is_inside).all()
        assert (at.at_accuracy(ACCURACY).in_range(views) == scorer.in_range(views)).all()


def test_depth_over_accuracy_does_not_depend_on_an_unknown_unit(tmp_path):
    """1 % of the depth is in range in any unit; in metres, 5 cm are a smaller share of a larger depth."""
    room = pycolmap.Reconstruction(write_room(tmp_path / "metric"))
    for image in room.images.values():  # the room's images also observe what is behind them
        for row, point in enumerate(image.points2D):
            known = point.has_point3D()
            if known and (image.cam_from_world() * room.points3D[point.point3D_id].xyz)[2] < 0.1:
                room.delete_observation(image.image_id, row)
    found = {}
    for unit in (1.0, 10.0):
        write_model(room, tmp_path / f"{unit}")
        for frame in ({}, {"scale": 1.0}):
            with warnings.catch_warnings(action="ignore", category=MapWarning):
                scorer = load_scorer(LocalizationMap.from_colmap(tmp_path / f"{unit}", **frame))
            assert isinstance(scorer, SetScorer) and scorer.localization_map.mapping_poses is not None
            views = scorer.localization_map.mapping_poses
            found[unit, bool(frame)] = scorer.in_range(views).mean(), len(warnings_of(scorer, views))
        Similarity(10.0, np.eye(3), np.zeros(3)).transform_model(room)
    assert found == {(1.0, False): (1, 0), (1.0, True): (1, 0), (10.0, False): (1, 0), (10.0, True): (0, 1)}


def warnings_of(scorer, views):
    """Texts of the warnings of range of scoring views."""
    with warnings.catch_warnings(record=True, action="always", category=OutOfRangeWarning) as warned:
        scorer.score(views)
    return [str(one.message) for one in warned]


def test_landmarks_mapped_from_one_place_are_out_of_range(poses):
    def seen_and_in_range(angle_deg, error_px, spread):
        landmarks = make_landmarks(
            np.random.default_rng(0), 400, triangulation_angle_deg=angle_deg, reprojection_error_px=error_px,
            mapping_distance_spread=spread,
        )  # fmt: skip
        report = load_scorer(LocalizationMap(Map(landmarks), PinholeCamera(400, 300, 200.0))).report(poses)
        return report.in_range & (report.n_visible > 0)

    assert seen_and_in_range(8.0, 0.1, 0.1).sum() > 10
    assert not seen_and_in_range(2.0, 0.3, 0.01).any()
    assert seen_and_in_range(8.0, 1.0, 0.1).sum() > 10  # photographs, mapped from several places
