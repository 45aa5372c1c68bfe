"""Figures of the paper that no item of the catalog draws from a store, and their geometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from box_scenes import furnished_room
from wheretolook.figures.floor_plan import save_figure
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import fibonacci_sphere, released_lattice
from wheretolook.geometry.poses import poses_looking_along
from wheretolook_paper.figures.dollhouse import dollhouse
from wheretolook_paper.figures.looks import Estimate, LookStory, film_frames, story_figure
from wheretolook_paper.figures.network import spread_extrema
from wheretolook_paper.figures.runtimes import scaling_figure, step_table
from wheretolook_paper.figures.sampling import covering_radius_deg, fibonacci_figure, nearest_angles_deg
from wheretolook_paper.figures.scores import training_figure

RNG = np.random.default_rng(0)
CAMERA = PinholeCamera(64, 48, 32.0)
RGB = np.full((48, 64, 3), 120, np.uint8)
CPU = {"device": "cpu", "name": "Intel(R) Xeon(R) Gold 6430 CPU @ 2.10GHz", "cores": 2}
GPU = {"device": "cuda:0", "name": "NVIDIA H200", "cores": 16}


def training() -> Figure:
    history = pd.DataFrame({"epoch": range(3), "train_bce": 0.5, "val_bce": 0.6, "train_average_precision": 0.9})
    return training_figure({"set": history.assign(val_average_precision=[0.1, 0.8, 0.7])})


def measured(machine: dict[str, object], what: str, threads: int, seconds: float) -> dict[str, object]:
    times = {"median_s": seconds, "min_s": 0.9 * seconds, "max_s": 1.2 * seconds}
    return {**machine, "what": what, "threads": threads, **times, "repeats": 20}


def scaling() -> Figure:
    rows = []
    for machine in (CPU, GPU):
        for axis, values in {"landmarks": (10, 1000), "locations": (8, 512), "directions": (50, 5000)}.items():
            for value in values:
                size = {"landmarks": 24_919, "locations": 64, "directions": 500, axis: value}
                row = measured(machine, "counts alone", 1, 1e-9 * float(np.prod(list(size.values()))))
                rows.append({**row, "axis": axis, **size, "peak_bytes": 1000 * value})
    return scaling_figure(pd.DataFrame(rows))


FIGURES = {"training": training, "scaling": scaling, "lattices": lambda: fibonacci_figure(200)}


@pytest.mark.parametrize("name", FIGURES)
def test_figures_can_be_drawn(name: str, tmp_path: Path) -> None:
    from matplotlib.image import imread

    save_figure(FIGURES[name](), tmp_path / "figure.png")
    image = imread(tmp_path / "figure.png")
    assert image.shape[0] > 100 and image.std() > 0.01


def test_covering_radius_of_platonic_solids_and_lattices() -> None:
    octahedron = np.concatenate([np.eye(3), -np.eye(3)])
    assert covering_radius_deg(octahedron) == pytest.approx(np.degrees(np.arccos(1 / np.sqrt(3))))
    np.testing.assert_allclose(nearest_angles_deg(octahedron), 90)
    probes = np.random.default_rng(0).normal(size=(50_000, 3))
    probes /= np.linalg.norm(probes, axis=1, keepdims=True)
    for lattice in (fibonacci_sphere, released_lattice):
        searched = np.degrees(np.arccos((probes @ lattice(200).T).max(1).min()))
        assert searched == pytest.approx(covering_radius_deg(lattice(200)), rel=0.06)


def test_extrema_are_spread() -> None:
    directions = fibonacci_sphere(300)
    scores = directions @ (0, 0, 1.0)
    peaks = spread_extrema(directions, scores, 4, 40.0)
    cosines = directions[peaks] @ directions[peaks].T
    assert cosines[~np.eye(len(peaks), dtype=bool)].max() <= np.cos(np.radians(40)) + 1e-12
    assert peaks[0] == 0 and np.all(np.diff(scores[peaks]) <= 0)
    assert spread_extrema(directions, scores, 1, 40.0, False).tolist() == [299]


def test_a_story_of_views_is_a_figure_and_a_film() -> None:
    poses = poses_looking_along([[1.0, 1, 1]] * 2, [[1.0, 0, 0], [0, 1.0, 0]])
    good = Estimate(poses[:1], (np.ones((5, 2)),), 0.9, 0.01, 0.1)
    none = Estimate(None, (np.zeros((0, 2)),), 0.0, np.inf, np.inf)
    joint = Estimate(poses, (np.ones((5, 2)), np.ones((2, 2))), 0.9, 0.01, 0.1)
    assert (good.is_good, none.is_good) == (True, False) and "7 inliers" in joint.summary
    story = LookStory(CAMERA, poses, np.stack([RGB, RGB]), (good, none), joint)
    house = dollhouse(furnished_room(), width_px=100)
    assert len(story_figure(story, house).axes) == 3 + 4
    assert len([*film_frames(story, house)]) == 3


def test_inference_steps_are_listed_below_the_papers() -> None:
    about = {"threads": 2, "cores": 2, "device": "cpu", "name": "AMD EPYC", "landmarks": 24_919}
    step = {"what": "mlp-2d+z, one pose", "locations": 1, "directions": 1, "median_s": 3e-3}
    step |= {"q1_s": 2e-3, "q3_s": 5e-3, "min_s": 1e-3}
    check = {"what": "counts alone", "locations": 648, "directions": 500, "median_s": 1.5}
    table = step_table(pd.DataFrame([check, step]).assign(**about))
    assert table["median (ms)"].tolist() == [20, 3]  # Sec. "Runtimes": one inference step takes around 0.02 s
    row = table.iloc[1]
    assert (row["machine"], row["scorer"], row["views"]) == ("AMD EPYC, all 2 cores", "mlp-2d+z", 1)
    assert (row["25 % (ms)"], row["75 % (ms)"], row["least (ms)"]) == (2, 5, 1)
    assert len(step_table(pd.DataFrame([check]).assign(**about))) == 1
