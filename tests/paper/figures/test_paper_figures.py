"""Figures of the paper can be drawn and hold the numbers of their input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from box_scenes import ROOM, furnished_room
from wheretolook.figures.dollhouse import dollhouse
from wheretolook.figures.overview import View
from wheretolook.figures.style import save_figure
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.geometry.lattices import VoxelGrid, fibonacci_sphere, released_lattice
from wheretolook.geometry.poses import poses_looking_along
from wheretolook_paper.figures.inputs import BinnedImage, inputs_figure
from wheretolook_paper.figures.lattices import covering_radius_deg, fibonacci_figure, nearest_angles_deg
from wheretolook_paper.figures.look_story import Estimate, LookStory, film_frames, story_figure
from wheretolook_paper.figures.looks import looks_figure
from wheretolook_paper.figures.network_walkthrough import learning_figure
from wheretolook_paper.figures.occlusion import occlusion_figure
from wheretolook_paper.figures.peaks import peaks_figure, spread_extrema
from wheretolook_paper.figures.pipeline import Pipeline, pipeline_figure
from wheretolook_paper.figures.runtimes import runtime_figure, scaling_figure
from wheretolook_paper.figures.sampling import Sampling, sampling_figure
from wheretolook_paper.figures.training import training_figure

RNG = np.random.default_rng(0)
CAMERA = PinholeCamera(64, 48, 32.0)
RGB = np.full((48, 64, 3), 120, np.uint8)
CPU = {"device": "cpu", "name": "Intel(R) Xeon(R) Gold 6430 CPU @ 2.10GHz", "cores": 2}
GPU = {"device": "cuda:0", "name": "NVIDIA H200", "cores": 16}


def pipeline() -> Figure:
    landmarks = RNG.uniform((0, 4.9, 0), ROOM, (200, 3))
    locations = np.stack(np.meshgrid([1.0, 2.0, 3.0], [2.0, 3.0], [1.4], indexing="ij"), -1).reshape(-1, 3)
    axes = fibonacci_sphere(6)
    poses = poses_looking_along(locations[:4], axes[:4])
    house = dollhouse(furnished_room(), width_px=240)
    scores = np.linspace(0, 1, 6)
    return pipeline_figure(
        Pipeline(house, landmarks, poses, CAMERA, locations, 17, 500, axes, scores, poses[1], 0.93,
                 np.arange(200) < 40, RGB, "pose found, 0.5 cm and 0.10° off")
    )  # fmt: skip


def sampling() -> Figure:
    plan = dollhouse(furnished_room(), elevation_deg=90, width_px=200)
    grid = VoxelGrid((0, 0, 0), ROOM, (4, 3, 2))
    layer = np.arange(len(grid))[::2]
    landmarks = RNG.uniform((0, 0, 0), ROOM, (60, 3))
    return sampling_figure(
        Sampling(plan, grid, layer, layer % 3 > 0, grid.centers()[layer[1]], fibonacci_sphere(50),
                 10 * np.arange(50)[::-1], np.arange(50) < 12, landmarks, np.arange(60) < 25)
    )  # fmt: skip


def binned_image() -> BinnedImage:
    counts = np.zeros((6, 6), np.int32)
    counts[0, 0] = 2
    means = {name: np.where(counts > 0, -1.25, np.nan) for name in "uvxyz"}
    return BinnedImage(RGB, np.array([[5.0, 5.0], [6.0, 6.0]]), means, counts)


def learning() -> Figure:
    layers = [RNG.normal(size=(2, 6, 6)), RNG.uniform(size=30), RNG.uniform(size=24), np.array([0.87])]
    return learning_figure(binned_image(), layers, "uv", "0.4 cm, 0.10° off")


def peaks() -> Figure:
    directions = fibonacci_sphere(80)
    views = [View(RGB, directions[row], row / 80, "0.2 cm, 0.05° off") for row in (79, 60, 0, 20)]
    tried = (directions[:30], np.arange(30) < 20)
    return peaks_figure(directions, np.linspace(0, 1, 80), views[:2], views[2:], tried)


def training() -> Figure:
    history = pd.DataFrame({"epoch": range(3), "train_bce": 0.5, "val_bce": 0.6, "train_average_precision": 0.9})
    return training_figure({"set": history.assign(val_average_precision=[0.1, 0.8, 0.7])})


def occlusion() -> Figure:
    rows = [
        {"method": method, "occlusion": model, "top_n": 1, "scene": "all", "average_precision": 0.5,
         "normalized_0.05m_0.4deg": 0.6, "normalized_low_0.05m_0.4deg": 0.5, "normalized_high_0.05m_0.4deg": 0.7,
         "any_0.05m_0.4deg": 0.6}
        for model in ("mesh", "none") for method in ("random", "bins", "mlp-2d", "oracle")
    ]  # fmt: skip
    return occlusion_figure(pd.DataFrame(rows))


def measured(machine: dict[str, object], what: str, threads: int, seconds: float) -> dict[str, object]:
    times = {"median_s": seconds, "min_s": 0.9 * seconds, "max_s": 1.2 * seconds}
    return {**machine, "what": what, "threads": threads, **times, "repeats": 20}


def runtimes() -> Figure:
    kinds = ("occlusion, counts, best 100", "counts alone")
    rows = [measured(machine, what, 1, 0.01) for machine in (CPU, GPU) for what in kinds]
    return runtime_figure(pd.DataFrame(rows))


def scaling() -> Figure:
    rows = []
    for machine in (CPU, GPU):
        for axis, values in {"landmarks": (10, 1000), "locations": (8, 512), "directions": (50, 5000)}.items():
            for value in values:
                size = {"landmarks": 24_919, "locations": 64, "directions": 500, axis: value}
                row = measured(machine, "counts alone", 1, 1e-9 * float(np.prod(list(size.values()))))
                rows.append({**row, "axis": axis, **size, "peak_bytes": 1000 * value})
    return scaling_figure(pd.DataFrame(rows))


def looks() -> Figure:
    rows = [("together", 1, 0.7, 0.7), ("together", 2, 0.8, 0.85), ("random", 1, 0.3, 0.3), ("random", 2, 0.5, np.nan)]
    table = pd.DataFrame(rows, columns=["strategy", "n_looks", "good", "any_good"])
    return looks_figure(table.assign(n_locations=40))


FIGURES = {
    "pipeline": pipeline,
    "sampling": sampling,
    "inputs": lambda: inputs_figure(binned_image()),
    "learning": learning,
    "peaks": peaks,
    "training": training,
    "occlusion": occlusion,
    "runtimes": runtimes,
    "scaling": scaling,
    "looks": looks,
    "lattices": lambda: fibonacci_figure(200),
}


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


def test_viewer_geometries_hold_the_scene() -> None:
    from wheretolook_paper.figures.viewer import scene_geometries

    mesh = furnished_room()
    landmarks = RNG.uniform(0, 3, (20, 3))
    poses = poses_looking_along([[1.0, 1, 1]], [[1.0, 0, 0]])
    parts = {one["name"]: one["geometry"] for one in scene_geometries(mesh, landmarks, poses, landmarks, CAMERA)}
    assert {"landmarks", "cameras", "path"} < {*parts}
    assert sum(len(part.triangles) for name, part in parts.items() if "mesh" in name) == len(mesh.triangles)
    np.testing.assert_allclose(np.asarray(parts["landmarks"].points), landmarks)


def test_a_story_of_views_is_a_figure_and_a_film() -> None:
    poses = poses_looking_along([[1.0, 1, 1]] * 2, [[1.0, 0, 0], [0, 1.0, 0]])
    good = Estimate(poses[:1], (np.ones((5, 2)),), 0.9, 0.01, 0.1)
    none = Estimate(None, (np.zeros((0, 2)),), 0.0, np.inf, np.inf)
    joint = Estimate(poses, (np.ones((5, 2)), np.ones((2, 2))), 0.9, 0.01, 0.1)
    assert (good.is_good, good.n_inliers, none.is_good, joint.n_inliers) == (True, 5, False, 7)
    story = LookStory(CAMERA, poses, np.stack([RGB, RGB]), (good, none), joint)
    house = dollhouse(furnished_room(), width_px=100)
    assert len(story_figure(story, house).axes) == 3 + 4
    assert len([*film_frames(story, house)]) == 3
