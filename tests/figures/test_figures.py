"""Figures of labels, scores, calibration and the overview draw the numbers of their input."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import to_hex
from matplotlib.lines import Line2D

from box_scenes import furnished_room
from synthetic_dataset import make_dataset
from synthetic_scores import EVERY_METHOD, FISHER, KEYS, make_scores
from wheretolook.evaluation.calibration import calibration_rows
from wheretolook.figures.calibration import calibration_figure
from wheretolook.figures.dollhouse import dollhouse
from wheretolook.figures.labels import SHADES, label_figure
from wheretolook.figures.overview import Overview, View, overview_figure
from wheretolook.figures.scores import regret_figure, score_figure
from wheretolook.geometry.camera_turns import pan_tilt_angles
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.localization.report import POSITIVE, label_summary
from wheretolook.scorers.styles import method_style

FEW = ("random", "visible", "bins", "mlp-2d")


def test_label_figure_draws_shares_and_errors(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path, ("test", "train", "val"), n_locations=6, n_directions=10, n_landmarks=200)
    tables = {scene.name: scene.read_table() for scene in dataset.scenes}
    summary = label_summary(tables, {scene.name: scene.split for scene in dataset.scenes})
    figure: Any = label_figure(summary)
    scenes, errors = figure.axes
    names = [label.get_text() for label in scenes.get_yticklabels()]
    assert names == ["scene 0 (test)", "scene 1 (train)", "scene 2 (val)", "all scenes"]
    rows = summary.shares.iloc[[0, 1, 2, -1]]
    for shade, column in zip(SHADES, (POSITIVE[0], POSITIVE[-1]), strict=True):
        widths = [bar.get_width() for bar in scenes.patches if to_hex(bar.get_facecolor()) == shade]
        np.testing.assert_allclose(widths, 100 * rows[column])
    assert sum(bar.get_height() for bar in errors.patches) == pytest.approx(100)
    assert errors.patches[-1].get_height() == pytest.approx(100 * summary.overall["without_pose"])


def row_of(scores: pd.DataFrame, method: str) -> pd.Series:
    return scores[(scores["method"] == method) & (scores["scene"] == "all") & (scores["top_n"] == 1)].iloc[0]


def mark_of(axes: Axes, method: str) -> Line2D:
    (mark,) = (line for line in axes.lines if line.get_label() == method_style(method).label)
    return mark


def whisker(axes: Any, y: float) -> list[float]:
    segments = [segment for lines in axes.collections for segment in lines.get_segments()]
    (segment,) = (segment for segment in segments if np.allclose(segment[:, 1], y))
    return [float(value) for value in segment[:, 0]]


@pytest.mark.parametrize("methods", [EVERY_METHOD, FEW])
def test_score_figure_draws_the_best_methods_first(methods: tuple[str, ...]) -> None:
    scores = make_scores(methods, reference="")
    figure = score_figure(scores)
    first = scores[(scores["scene"] == "all") & (scores["top_n"] == 1) & (scores["method"] != "oracle")]
    ordered = first.sort_values(f"normalized_{KEYS[0]}", ascending=False, kind="stable")["method"]
    fisher = [name for name in ordered if name in FISHER][:3]
    shown = [name for name in ordered if name in fisher or not name.startswith("fisher")]
    labels = [text.get_text().replace("\n", " ") for text in figure.axes[0].get_yticklabels()]
    assert labels == [method_style(method).label for method in shown]
    for axes, key in zip(figure.axes, (KEYS[0], KEYS[-1]), strict=True):
        for y, method in enumerate(shown):
            row = row_of(scores, method)
            assert mark_of(axes, method).get_xdata() == pytest.approx([100 * row[f"normalized_{key}"]])
            assert whisker(axes, y) == pytest.approx([100 * row[f"normalized_{end}_{key}"] for end in ("low", "high")])


def test_regret_figure_draws_regret_and_difference() -> None:
    scores = make_scores()
    worse = make_scores(seed=1).assign(occlusion="none")  # of a second occlusion model, not drawn
    figure = regret_figure(pd.concat([scores, worse], ignore_index=True))
    for axes, name in zip(figure.axes, ("regret", "difference"), strict=True):
        for method in ("bins", "mlp-2d", "visible"):
            mark = mark_of(axes, method)
            assert mark.get_xdata() == pytest.approx([100 * row_of(scores, method)[f"{name}_{KEYS[0]}"]])
    assert len(regret_figure(make_scores(FEW, reference="")).axes) == 1
    with pytest.raises(ValueError, match="regret"):
        regret_figure(scores.drop(columns=[name for name in scores if "regret" in str(name)]))


def test_calibration_figure_draws_the_curves() -> None:
    rng = np.random.default_rng(0)
    probability = rng.random(500)
    table = calibration_rows(probability, rng.random(500) < probability, 2.0).assign(method="mlp-2d", temperature=2.0)
    figure: Any = calibration_figure(table)
    curve, counts = figure.axes
    for line, patch, when in zip(curve.lines[1:], counts.patches, ("before", "after"), strict=True):
        rows = table[table["when"] == when]
        np.testing.assert_allclose(line.get_xydata(), rows.loc[rows["n"] > 0, ["mean_predicted", "share_good"]])
        np.testing.assert_array_equal(patch.get_data().values, rows["n"])


def test_overview_draws_locations_scores_and_both_views() -> None:
    plan = dollhouse(furnished_room(), elevation_deg=90, cut_m=1.5, one_sided=False, width_px=240)
    locations = np.array([[1.0, 2.0, 1.4], [2.0, 3.0, 1.4], [3.0, 1.0, 1.4]])
    directions = fibonacci_sphere(80)
    scores = np.linspace(0, 1, 80)
    shares = np.array([0.2, 0.9, 0.5])
    rgb = np.full((48, 64, 3), 90, np.uint8)
    best, worst = (View(rgb, directions[row], float(scores[row]), f"outcome {row}") for row in (79, 30))
    figure = overview_figure(
        Overview("a room", "set", plan, locations, shares, locations[1], directions, scores, best, worst)
    )
    sphere = next(axes for axes in figure.axes if axes.name == "hammer")
    (dots,) = (one for one in figure.axes[0].collections if isinstance(one, PathCollection))
    order = np.argsort(shares)
    np.testing.assert_allclose(dots.get_offsets(), plan.pixels(locations)[order])
    np.testing.assert_allclose(sphere.collections[0].get_offsets(), np.transpose(pan_tilt_angles(directions)))
