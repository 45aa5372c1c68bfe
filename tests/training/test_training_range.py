"""The range of the training views, and views outside it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from wheretolook.geometry.camera import PinholeCamera
from wheretolook.inputs.landmark_features import ViewLandmarks
from wheretolook.training.trained_network import (
    QUANTITIES,
    TrainingRange,
    bin_quantities,
    camera_quantities,
    view_quantities,
)

CAMERA = PinholeCamera()


def views_at(distances_m, camera=CAMERA):
    counts = torch.tensor([0, *map(len, distances_m)])
    values = torch.tensor([np.log(one) for view in distances_m for one in view], dtype=torch.float32)[:, None]
    landmarks = ViewLandmarks(counts.cumsum(0), torch.zeros(len(values), dtype=torch.int64), values, ("distance",))
    return view_quantities(landmarks, counts[1:], camera_quantities(camera))


def test_views_by_hand():
    distance, depth, in_view, across, down, focal = views_at([[1.0, 4.0], [], [3.0]]).T
    assert_allclose(distance, [2.0, np.nan, 3.0], rtol=1e-6)
    assert_array_equal(in_view, [2, np.nan, 1])
    assert np.isnan(depth).all()
    assert_allclose([across, down, focal], np.outer([90, 73.7398, 320], np.ones(3)), rtol=1e-5)
    assert_array_equal(bin_quantities(np.array([6.0, 0.0]), np.array([3, 0]))[:, 1], [2.0, np.nan])
    assert not np.isfinite(views_at([[], []])[:, :3]).any()


def test_most_training_views_are_in_range(rng):
    views = views_at([rng.uniform(1, 4, rng.integers(0, 60)).tolist() for _ in range(2000)])
    known = TrainingRange.of(views)
    assert known.contains(views).mean() > 0.95 and known.contains(views_at([[]]))[0]
    assert not known.complaint(views, 0.05) and TrainingRange.of_record(known.record()) == known
    far = views_at([[12.0] * 9] * 3 + [[]])
    near = views_at([[2.0] * 9])
    assert known.contains(far).tolist() == [False] * 3 + [True] and known.contains(near).all()
    distance_m = views[np.isfinite(views[:, 0]), 0]
    assert known.bounds["distance_m"] == pytest.approx(
        (np.quantile(distance_m, 0.005) / 1.25, np.quantile(distance_m, 0.975)), abs=1e-4
    )
    assert known.complaint(far)
    assert known.outside(views_at([[2.0] * 500])).sum(0)[[*QUANTITIES].index("in_view")] == 1
    assert not known.complaint(np.concatenate([near] * 99 + [far]), 0.05)  # three odd ones in a hundred


@pytest.mark.parametrize(
    ("camera", "inside"),
    [
        (CAMERA, True),
        (replace(CAMERA, focal_px=315.0), True),
        (PinholeCamera(320, 240, 160.0), True),
        (PinholeCamera(480, 640, 320.0), False),  # upright
        (replace(CAMERA, focal_px=900.0), False),
        (PinholeCamera.of_field_of_view(110, 640, 480), False),
    ],
)
def test_where_only_the_camera_is_known(camera, inside):
    known = TrainingRange.of_camera(CAMERA)
    assert known.contains(views_at([[1.0], [], [900.0] * 4000], camera)).tolist() == [inside] * 3
    assert bool(known.complaint(views_at([[1.0]], camera))) != inside
    assert TrainingRange.of_camera(None).contains(views_at([[1.0]], camera)).all()


def test_a_finer_accuracy_is_in_range_at_distances_as_many_times_shorter():
    known = TrainingRange({"distance_m": (0.4, 15.0), "in_view": (1.0, 100.0)})
    assert known.at_accuracy(1.0) == known.at_accuracy(5.0) == known
    assert known.at_accuracy(0.2).bounds == {"distance_m": (0.4, 3.0), "in_view": (1.0, 100.0)}
    assert known.at_accuracy(0.01).bounds["distance_m"] == (0.15, 0.15)  # ascending, as robots demand
    views = views_at([[2.9], [3.1], [14.9], [15.1]])
    assert known.at_accuracy(0.2).contains(views).tolist() == [True, False, False, False]
    assert known.at_accuracy(5.0).contains(views).tolist() == [True, True, True, False]
    assert "3.1 m (in range: 0.4 to 3)" in known.at_accuracy(0.2).complaint(views[:2])


def test_views_without_landmarks_have_no_range():
    assert TrainingRange.of(views_at([[], []])).bounds == {}
    with pytest.raises((TypeError, IndexError, ValueError)):
        TrainingRange.of_record({"in_view": [1.0]})


def test_each_view_names_the_quantities_that_are_out_of_range():
    known = TrainingRange({"distance_m": (0.4, 16.0), "focal_px": (100.0, 1000.0)})
    quantities = np.full((3, 6), np.nan)
    quantities[:, 0] = 2.0, 20.0, np.nan
    quantities[:, 5] = 500.0, 500.0, 2000.0
    inside, far, fine = known.texts(quantities)
    assert inside == "" and "20" in far and "0.4 to 16" in far and "pixel" not in far
    # an angle: arctan(1 / 2000) is 0.0286 degrees, and 1000 to 100 px are 0.0573 to 0.573 degrees
    assert "0.029 degrees (in range: 0.0573 to 0.573)" in fine
