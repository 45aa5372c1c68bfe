"""Figures of the paper that no item of the catalog draws from a store, and their geometry."""

import numpy as np
import pandas as pd
import pytest

from box_scenes import furnished_room
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import fibonacci_sphere, released_lattice
from wheretolook.geometry.poses import poses_looking_along
from wheretolook_paper.figures.dollhouse import dollhouse
from wheretolook_paper.figures.looks import Estimate, LookStory, film_frames, story_figure
from wheretolook_paper.figures.network import spread_extrema
from wheretolook_paper.figures.runtimes import step_table
from wheretolook_paper.figures.sampling import covering_radius_deg, nearest_angles_deg


def test_covering_radius_of_platonic_solids_and_lattices():
    octahedron = np.concatenate([np.eye(3), -np.eye(3)])
    assert covering_radius_deg(octahedron) == pytest.approx(np.degrees(np.arccos(1 / np.sqrt(3))))
    np.testing.assert_allclose(nearest_angles_deg(octahedron), 90)
    probes = np.random.default_rng(0).normal(size=(50_000, 3))
    probes /= np.linalg.norm(probes, axis=1, keepdims=True)
    for lattice in (fibonacci_sphere, released_lattice):
        searched = np.degrees(np.arccos((probes @ lattice(200).T).max(1).min()))
        assert searched == pytest.approx(covering_radius_deg(lattice(200)), rel=0.06)


def test_extrema_are_spread():
    directions = fibonacci_sphere(300)
    scores = directions @ (0, 0, 1.0)
    peaks = spread_extrema(directions, scores, 4, 40.0)
    cosines = directions[peaks] @ directions[peaks].T
    assert cosines[~np.eye(len(peaks), dtype=bool)].max() <= np.cos(np.radians(40)) + 1e-12
    assert peaks[0] == 0 and np.all(np.diff(scores[peaks]) <= 0)
    assert spread_extrema(directions, scores, 1, 40.0, False).tolist() == [299]


def test_a_story_of_views_is_a_figure_and_a_film():
    poses = poses_looking_along([[1.0, 1, 1]] * 2, [[1.0, 0, 0], [0, 1.0, 0]])
    good = Estimate(poses[:1], (np.ones((5, 2)),), 0.9, 0.01, 0.1)
    none = Estimate(None, (np.zeros((0, 2)),), 0.0, np.inf, np.inf)
    joint = Estimate(poses, (np.ones((5, 2)), np.ones((2, 2))), 0.9, 0.01, 0.1)
    assert (good.is_good, none.is_good) == (True, False)
    rgb = np.full((2, 48, 64, 3), 120, np.uint8)
    story = LookStory(PinholeCamera(64, 48, 32.0), poses, rgb, (good, none), joint)
    house = dollhouse(furnished_room(), width_px=100)
    assert len(story_figure(story, house).axes) == 3 + 4 and len([*film_frames(story, house)]) == 3


def test_inference_steps_are_listed_below_the_papers():
    about = {"threads": 2, "cores": 2, "device": "cpu", "name": "AMD EPYC", "landmarks": 24_919}
    step = {
        "what": "mlp-2d+z, one pose",
        "locations": 1,
        "directions": 1,
        "median_s": 3e-3,
        "q1_s": 2e-3,
        "q3_s": 5e-3,
        "min_s": 1e-3,
    }
    check = {"what": "counts alone", "locations": 648, "directions": 500, "median_s": 1.5}  # is no inference step
    table = step_table(pd.DataFrame([check, step]).assign(**about))
    assert table["median (ms)"].tolist() == [20, 3]  # Sec. "Runtimes": one inference step takes around 0.02 s
    names = ("machine", "scorer", "views", "25 % (ms)", "75 % (ms)", "least (ms)")
    assert table.iloc[1][[*names]].tolist() == ["AMD EPYC, all 2 cores", "mlp-2d+z", 1, 2, 5, 1]
