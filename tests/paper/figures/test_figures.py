"""Figures of labels, scores, calibration and the overview draw the numbers of their input."""

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex

from box_scenes import furnished_room
from labelled_tables import HALL, SHED, SPLITS
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


def test_label_figure_draws_shares_and_errors():
    summary = label_summary(pooled_labels({"hall": HALL, "shed": SHED}, SPLITS))
    scenes, errors = label_figure(summary).axes
    assert [label.get_text() for label in scenes.get_yticklabels()] == ["hall (train)", "shed (test)", "all scenes"]
    for shade, column in zip(SHADES, (POSITIVE[0], POSITIVE[-1]), strict=True):
        widths = [bar.get_width() for bar in scenes.patches if to_hex(bar.get_facecolor()) == shade]
        np.testing.assert_allclose(widths, 100 * summary.shares.iloc[[0, 1, -1]][column])
    heights = [bar.get_height() for bar in errors.patches]
    assert sum(heights) == pytest.approx(100) and heights[-1] == pytest.approx(100 * summary.overall["without_pose"])


def first_rows(scores):
    rows = scores[(scores["scene"] == "all") & (scores["top_n"] == 1) & (scores["method"] != "oracle")]
    return rows.set_index("method").sort_values(f"normalized_{KEYS[0]}", ascending=False, kind="stable")


def marks(axes):
    """Return the drawn value of each method by its label."""
    return {line.get_label(): line.get_xdata()[0] for line in axes.lines if len(line.get_xdata()) == 1}


def test_score_figure_draws_the_best_methods_first():
    scores = make_scores(EVERY_METHOD, reference="")
    figure = score_figure(scores)
    rows = first_rows(scores)
    fisher = [name for name in rows.index if name in FISHER][:3]
    rows = rows.loc[[name for name in rows.index if name in fisher or not name.startswith("fisher")]]
    names = [method_style(method).label for method in rows.index]
    assert [text.get_text().replace("\n", " ") for text in figure.axes[0].get_yticklabels()] == names
    for axes, key in zip(figure.axes, (KEYS[0], KEYS[-1]), strict=True):
        assert marks(axes) == pytest.approx(dict(zip(names, 100 * rows[f"normalized_{key}"], strict=True)))
        whiskers = [lines.get_segments()[0][:, 0] for lines in axes.collections]
        np.testing.assert_allclose(whiskers, 100 * rows[[f"normalized_low_{key}", f"normalized_high_{key}"]])


def test_regret_figure_draws_regret_and_difference():
    scores = make_scores()
    worse = make_scores(seed=1).assign(occlusion="none")  # of a second occlusion model, not drawn
    for axes, name in zip(regret_figure(pd.concat([scores, worse])).axes, ("regret", "difference"), strict=True):
        values = 100 * first_rows(scores)[f"{name}_{KEYS[0]}"]
        assert marks(axes)[method_style("bins").label] == pytest.approx(values["bins"])
    assert len(regret_figure(make_scores(reference="")).axes) == 1


def test_calibration_figure_draws_the_curves():
    rng = np.random.default_rng(0)
    probability = rng.random(500)
    table = calibration_rows(probability, rng.random(500) < probability, 2.0).assign(method="mlp-2d", temperature=2.0)
    figure = calibration_figure(table)
    curve, counts = figure.axes
    for line, patch, when in zip(curve.lines[1:], counts.patches, ("before", "after"), strict=True):
        rows = table[table["when"] == when]
        np.testing.assert_allclose(line.get_xydata(), rows.loc[rows["n"] > 0, ["mean_predicted", "share_good"]])
        np.testing.assert_array_equal(patch.get_data().values, rows["n"])


def test_overview_draws_locations_and_scores():
    plan = dollhouse(furnished_room(), elevation_deg=90, cut_m=1.5, one_sided=False, width_px=240)
    locations = np.array([[1.0, 2.0, 1.4], [2.0, 3.0, 1.4], [3.0, 1.0, 1.4]])
    directions = fibonacci_sphere(80)
    shares = np.array([0.2, 0.9, 0.5])
    view = View(plan.rgb, directions[0], 0.5, "")
    scores = np.linspace(0, 1, 80)
    drawn = Overview("a room", "set", plan, locations, shares, locations[1], directions, scores, view, view)
    axes = {axes.name: axes for axes in reversed(overview_figure(drawn).axes)}
    dots, angles = (axes[name].collections[0].get_offsets() for name in ("rectilinear", "hammer"))
    np.testing.assert_allclose(dots, plan.pixels(locations)[np.argsort(shares)])
    np.testing.assert_allclose(angles, np.transpose(pan_tilt_angles(directions)))
