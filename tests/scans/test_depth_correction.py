"""Depths of a structured-light camera are corrected by landmarks whose depths are known."""

from __future__ import annotations

import numpy as np
import pytest

from wheretolook.scans.depth_correction import DepthCorrection, fit_depth_correction


def test_the_correction_is_found_though_a_third_of_the_readings_are_of_something_else():
    rng = np.random.default_rng(0)
    true_m = rng.uniform(0.6, 4.0, 3000)
    read_m = 0.98 / (1 / true_m - 0.02) * (1 + 0.01 * rng.standard_normal(3000))
    read_m[::3] *= rng.uniform(0.4, 0.9, 1000)  # something in front
    found = fit_depth_correction(true_m, read_m)
    assert found.factor == pytest.approx(0.98, abs=0.004) and found.offset_per_m == pytest.approx(0.02, abs=0.002)
    assert np.median(np.abs(found.apply(read_m.astype(np.float32)) / true_m - 1)[1::3]) < 0.01


def test_readings_that_are_right_stay_and_no_reading_stays_none():
    true_m = np.linspace(0.5, 4.0, 500)
    found = fit_depth_correction(true_m, true_m)
    assert found.factor == pytest.approx(1, abs=1e-6) and found.offset_per_m == pytest.approx(0, abs=1e-6)
    assert DepthCorrection(1.0, -0.1).apply(np.float32([0, 1, 20])).tolist() == pytest.approx([0, 1 / 0.9, 0])


def test_it_is_not_guessed_from_few_landmarks_or_from_one_depth():
    assert fit_depth_correction(np.linspace(1, 4, 50), np.linspace(1, 4, 50)) is None
    assert fit_depth_correction(np.linspace(1.0, 1.2, 500), np.linspace(1.0, 1.2, 500)) is None
