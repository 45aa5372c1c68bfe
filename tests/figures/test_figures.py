"""Figures can be drawn and say what the data say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from wheretolook.evaluation.config import EvaluateConfig
from wheretolook.evaluation.ranking import TestViews
from wheretolook.evaluation.scores import score_table
from wheretolook.figures.lattices import covering_radius_deg, fibonacci_figure, nearest_angles_deg
from wheretolook.figures.scores import score_figure
from wheretolook.figures.sphere import viewpoint_sphere_figure
from wheretolook.figures.style import method_style, save_figure
from wheretolook.figures.training import training_figure
from wheretolook.grid import fibonacci_sphere, released_lattice


def test_covering_radius_of_platonic_solids() -> None:
    octahedron = np.concatenate([np.eye(3), -np.eye(3)])
    cube = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3) / np.sqrt(3)
    assert covering_radius_deg(octahedron) == pytest.approx(np.degrees(np.arccos(1 / np.sqrt(3))))
    assert covering_radius_deg(cube) == pytest.approx(np.degrees(np.arccos(1 / np.sqrt(3))))
    np.testing.assert_allclose(nearest_angles_deg(octahedron), 90)
    np.testing.assert_allclose(nearest_angles_deg(cube), np.degrees(np.arccos(1 / 3)))


@pytest.mark.parametrize("lattice", [fibonacci_sphere, released_lattice])
def test_covering_radius_against_a_dense_search(lattice) -> None:  # type: ignore[no-untyped-def]
    directions = lattice(200)
    probes = np.random.default_rng(0).normal(size=(100_000, 3))
    probes /= np.linalg.norm(probes, axis=1, keepdims=True)
    searched = np.degrees(np.arccos((probes @ directions.T).max(1).min()))
    assert searched <= covering_radius_deg(directions) + 1e-9
    assert searched == pytest.approx(covering_radius_deg(directions), rel=0.05)


def test_fibonacci_figure_tells_the_radii(tmp_path: Path) -> None:
    figure = fibonacci_figure(500)
    titles = [axes.get_title() for axes in figure.axes]
    assert len(titles) == 3
    captions = [axes.texts[0].get_text() for axes in figure.axes]
    assert captions[0] == "covering radius 7.0°\nnearest neighbours 7.9° to 9.0°"
    assert "covering radius 20.4°" in captions[2]
    _assert_draws(figure, tmp_path)


def test_score_figure_has_a_bar_for_every_method_and_threshold(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    location = np.repeat(np.arange(10), 6)
    views = TestViews(location, np.arange(60), rng.random((60, 1)) < [0.2, 0.4, 0.5, 0.6], np.zeros(10, dtype=int))
    methods = [("random", ""), ("bins", ""), ("mlp", "2d"), ("a new one", "")]
    config = EvaluateConfig(top_n=(1, 5), resamples=50)
    scores = score_table(views, {method: rng.random(60) for method in methods}, ["a"], config)
    figure = score_figure(scores)
    assert len(figure.axes) == 2
    row = scores[(scores["scene"] == "all") & (scores["method"] == "bins") & (scores["top_n"] == 5)].iloc[0]
    for axes in figure.axes:
        assert len(axes.patches) == 4 * 4
    heights = [patch.get_height() for patch in figure.axes[1].patches[4:8]]
    expected = [100 * row[name] for name in scores.columns if name.startswith("normalized_") and name.count("_") == 2]
    np.testing.assert_allclose(heights, expected)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [method_style(*m).label for m in methods]
    _assert_draws(figure, tmp_path)


def test_training_figure_marks_the_best_epoch(tmp_path: Path) -> None:
    history = pd.DataFrame({"epoch": range(5), "train_bce": 0.5, "val_bce": 0.6, "train_average_precision": 0.9,
                            "val_average_precision": [0.1, 0.4, 0.8, 0.7, 0.8]})  # fmt: skip
    figure = training_figure({"2d": history, "2d+3d": history + 0.01})
    rings = [line for line in figure.axes[1].lines if line.get_marker() == "o"]
    assert [line.get_xdata()[0] for line in rings] == [2, 2.01]
    _assert_draws(figure, tmp_path)


def test_sphere_figure_stars_the_best_direction(tmp_path: Path) -> None:
    directions, best = fibonacci_sphere(100), 37
    scores = {("bins", ""): -np.abs(np.arange(100) - best).astype(float), ("mlp", "2d"): np.arange(100.0)}
    figure = viewpoint_sphere_figure(directions, scores, np.arange(100) < 20)
    x, y = (float(values[0]) for values in figure.axes[0].lines[0].get_data())
    np.testing.assert_allclose([np.cos(y) * np.cos(x), np.cos(y) * np.sin(x), np.sin(y)], directions[best], atol=1e-12)
    assert len(figure.axes) == 2
    _assert_draws(figure, tmp_path)


def test_methods_look_different() -> None:
    methods = [("oracle", ""), ("random", ""), ("visible", ""), ("bins", ""), ("mlp", "2d"), ("mlp", "2d+z"),
               ("mlp", "2d+3d")]  # fmt: skip
    styles = [method_style(*method) for method in methods]
    for name in ("label", "color", "marker"):
        assert len({getattr(style, name) for style in styles}) == len(methods)
    assert method_style("new") == method_style("new")


def _assert_draws(figure, folder: Path) -> None:  # type: ignore[no-untyped-def]
    from matplotlib.image import imread

    save_figure(figure, folder / "figure.png")
    image = imread(folder / "figure.png")
    assert image.shape[0] > 300
    assert image.std() > 0.01
    assert [path.name for path in folder.iterdir()] == ["figure.png"]
