"""Figures of labels, scores, calibration and the overview draw the numbers of their input."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex

from box_scenes import furnished_room
from synthetic_dataset import make_dataset
from synthetic_scores import EVERY_METHOD, FISHER, KEYS, make_scores
from wheretolook.dataset.viewpoint_table import POSITIVE, pooled_labels
from wheretolook.evaluation.statistics import calibration_rows
from wheretolook.geometry.lattices import fibonacci_sphere
from wheretolook.geometry.poses import pan_tilt_angles
from wheretolook_paper.evaluation.label_report import label_summary
from wheretolook_paper.figures.dollhouse import dollhouse
from wheretolook_paper.figures.labels import SHADES, label_figure
from wheretolook_paper.figures.overview import Overview, View, overview_figure
from wheretolook_paper.figures.scores import calibration_figure, regret_figure, score_figure
from wheretolook_paper.styles import method_style


def test_label_figure_draws_shares_and_errors(tmp_path: Path) -> None:
    dataset = make_dataset(tmp_path, ("test", "train", "val"), n_locations=6, n_directions=10, n_landmarks=200)
    tables = {scene.name: scene.read_table() for scene in dataset.scenes}
    summary = label_summary(pooled_labels(tables, {scene.name: scene.split for scene in dataset.scenes}))
    figure: Any = label_figure(summary)
    scenes, errors = figure.axes
    names = [label.get_text() for label in scenes.get_yticklabels()]
    assert names == ["scene 0 (test)", "scene 1 (train)", "scene 2 (val)", "all scenes"]
    for shade, column in zip(SHADES, (POSITIVE[0], POSITIVE[-1]), strict=True):
        widths = [bar.get_width() for bar in scenes.patches if to_hex(bar.get_facecolor()) == shade]
        np.testing.assert_allclose(widths, 100 * summary.shares.iloc[[0, 1, 2, -1]][column])
    heights = [bar.get_height() for bar in errors.patches]
    assert sum(heights) == pytest.approx(100) and heights[-1] == pytest.approx(100 * summary.overall["without_pose"])


def first_rows(scores: pd.DataFrame) -> pd.DataFrame:
    rows = scores[(scores["scene"] == "all") & (scores["top_n"] == 1) & (scores["method"] != "oracle")]
    return rows.set_index("method").sort_values(f"normalized_{KEYS[0]}", ascending=False, kind="stable")


def marks(axes: Any) -> dict[str, float]:
    """Return the drawn value of each method by its label."""
    return {line.get_label(): line.get_xdata()[0] for line in axes.lines if len(line.get_xdata()) == 1}


def test_score_figure_draws_the_best_methods_first() -> None:
    scores = make_scores(EVERY_METHOD, reference="")
    figure: Any = score_figure(scores)
    rows = first_rows(scores)
    fisher = [name for name in rows.index if name in FISHER][:3]
    rows = rows.loc[[name for name in rows.index if name in fisher or not name.startswith("fisher")]]
    names = [method_style(method).label for method in rows.index]
    assert [text.get_text().replace("\n", " ") for text in figure.axes[0].get_yticklabels()] == names
    for axes, key in zip(figure.axes, (KEYS[0], KEYS[-1]), strict=True):
        assert marks(axes) == pytest.approx(dict(zip(names, 100 * rows[f"normalized_{key}"], strict=True)))
        whiskers = [lines.get_segments()[0][:, 0] for lines in axes.collections]
        np.testing.assert_allclose(whiskers, 100 * rows[[f"normalized_low_{key}", f"normalized_high_{key}"]])


def test_regret_figure_draws_regret_and_difference() -> None:
    scores = make_scores()
    worse = make_scores(seed=1).assign(occlusion="none")  # of a second occlusion model, not drawn
    figure = regret_figure(pd.concat([scores, worse], ignore_index=True))
    for axes, name in zip(figure.axes, ("regret", "difference"), strict=True):
        values = 100 * first_rows(scores)[f"{name}_{KEYS[0]}"]
        for method in ("bins", "mlp-2d", "visible"):
            assert marks(axes)[method_style(method).label] == pytest.approx(values[method])
    assert len(regret_figure(make_scores(reference="")).axes) == 1


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


def test_overview_draws_locations_and_scores() -> None:
    plan = dollhouse(furnished_room(), elevation_deg=90, cut_m=1.5, one_sided=False, width_px=240)
    locations = np.array([[1.0, 2.0, 1.4], [2.0, 3.0, 1.4], [3.0, 1.0, 1.4]])
    directions = fibonacci_sphere(80)
    scores = np.linspace(0, 1, 80)
    shares = np.array([0.2, 0.9, 0.5])
    best, worst = (View(plan.rgb, directions[row], float(scores[row]), "") for row in (79, 30))
    drawn = Overview("a room", "set", plan, locations, shares, locations[1], directions, scores, best, worst)
    figure = overview_figure(drawn)
    sphere = next(axes for axes in figure.axes if axes.name == "hammer")
    dots = figure.axes[0].collections[0]
    np.testing.assert_allclose(dots.get_offsets(), plan.pixels(locations)[np.argsort(shares)])
    np.testing.assert_allclose(sphere.collections[0].get_offsets(), np.transpose(pan_tilt_angles(directions)))
