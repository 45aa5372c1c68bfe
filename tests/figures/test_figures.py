"""Figures can be drawn and say what the data say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_rgb

from wheretolook.figures.style import save_figure
from wheretolook.geometry.lattices import fibonacci_sphere, released_lattice
from wheretolook.scorers.styles import method_group, method_style
from wheretolook_paper.figures.lattices import covering_radius_deg, fibonacci_figure, nearest_angles_deg
from wheretolook_paper.figures.training import training_figure
from wheretolook_paper.scorers.fisher import APPROXIMATIONS, METRICS


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


def test_training_figure_marks_the_best_epoch(tmp_path: Path) -> None:
    history = pd.DataFrame({"epoch": range(5), "train_bce": 0.5, "val_bce": 0.6, "train_average_precision": 0.9,
                            "val_average_precision": [0.1, 0.4, 0.8, 0.7, 0.8]})  # fmt: skip
    figure = training_figure({"mlp-2d": history, "mlp-2d+3d": history + 0.01})
    rings = [line for line in figure.axes[1].lines if line.get_marker() == "o"]
    assert [line.get_xdata()[0] for line in rings] == [3, 3.01]
    _assert_draws(figure, tmp_path)


def test_training_figure_names_learners_as_other_figures_do() -> None:
    history = pd.DataFrame({name: [0.5, 0.6] for name in (
        "train_bce", "val_bce", "train_average_precision", "val_average_precision")}).assign(epoch=[0, 1])  # fmt: skip
    labels = training_figure({"set": history}).axes[1].get_legend_handles_labels()[1]
    assert labels == ["set of landmarks: training", "set of landmarks: validation"]


def test_methods_look_different() -> None:
    methods = ["oracle", "random", "forward", "visible", "bins", "max-visibility",
               "max-visibility-swapped", "fisher-worst-trace", "fisher-stationary-trace", "mlp-2d", "mlp-2d+z",
               "mlp-2d+3d", "mlp-released"]  # fmt: skip
    styles = [method_style(method) for method in methods]
    for name in ("label", "color", "marker"):
        assert len({getattr(style, name) for style in styles}) == len(methods)
    assert method_style("new") == method_style("new")
    assert {method_group(name) for name in methods[:7]} == {"rules"}


def test_fisher_rows_are_one_family() -> None:
    """A marker for each metric, a shade for each approximation, dark to light also in greyscale."""
    styles = {
        f"{metric} {approximation}": method_style(f"fisher-{metric}-{approximation}")
        for metric in METRICS
        for approximation in APPROXIMATIONS
    }
    assert len({style.label for style in styles.values()}) == len(styles) == 9
    for name, style in styles.items():
        metric, approximation = name.split()
        assert style.marker == styles[f"{metric} exact"].marker
        assert style.color == styles[f"mineig {approximation}"].color
    assert len({style.marker for style in styles.values()}) == len({style.color for style in styles.values()}) == 3
    weights = np.array([0.299, 0.587, 0.114])
    greys = [weights @ to_rgb(styles[f"trace {one}"].color) for one in ("exact", "quadratic", "gp")]
    assert np.diff(greys).min() > 0.15
    assert styles["mineig exact"].label == "Fisher, min. eigenvalue, exact"
    assert method_group("fisher-trace-gp") == "Fisher"
    assert method_group("fisher-worst-trace") == method_group("fisher-stationary-trace") == "probes"
    assert method_group("mlp-2d") == "learned"


def _assert_draws(figure, folder: Path) -> None:  # type: ignore[no-untyped-def]
    from matplotlib.image import imread

    save_figure(figure, folder / "figure.png")
    image = imread(folder / "figure.png")
    assert image.shape[0] > 300
    assert image.std() > 0.01
    assert [path.name for path in folder.iterdir()] == ["figure.png"]
