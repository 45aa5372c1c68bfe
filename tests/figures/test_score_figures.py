"""The figures of score tables and of calibration hold the tables' numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.lines import Line2D

from synthetic_scores import EVERY_METHOD, KEYS, make_scores, older
from wheretolook.evaluation.calibration import calibration_rows
from wheretolook.figures.calibration import calibration_figure
from wheretolook.figures.scores import regret_figure, score_figure
from wheretolook.figures.style import save_figure
from wheretolook.methods.styles import method_style

FEW: tuple[str, ...] = ("random", "visible", "bins", "mlp-2d")
FAR = ("random", "forward", "max-visibility-swapped", "fisher-worst-trace", "fisher-stationary-trace")


@pytest.mark.parametrize("methods", [EVERY_METHOD, FEW])
def test_score_figure_draws_every_method(methods: tuple[str, ...], tmp_path: Path) -> None:
    scores = make_scores(methods, reference="")
    figure = score_figure(scores)
    figure.draw_without_rendering()  # sets the axes above
    assert [axes.get_title() for axes in figure.axes] == [
        "within 5 cm, 0.4°", "within 25 cm, 2°", "within 0.5 m, 5°", "within 5 m, 10°",
    ]  # fmt: skip
    labels = [text.get_text().replace("\n", " ") for text in figure.axes[0].get_yticklabels()]
    assert sorted(labels) == sorted(method_style(method).label for method in methods)
    assert labels[0].startswith("MLP")
    near = [method for method in methods if method not in FAR]
    for axes, key in zip(figure.axes, KEYS, strict=True):
        low, high = axes.get_xlim()
        assert 50 < low < 80 and high > 100
        assert [*axes.lines[0].get_xdata()] == [100, 100]
        for method in near:
            row = _row(scores, method, 1)
            (mark,) = _marks(axes, method)
            assert mark.get_xdata() == pytest.approx([100 * row[f"normalized_{key}"]])
            y = mark.get_ydata()[0]
            assert labels[[*axes.get_yticks()].index(y)] == method_style(method).label
            ends = [100 * row[f"normalized_{end}_{key}"] for end in ("low", "high")]
            assert _whisker(axes, y) == pytest.approx(ends)
            others = [line for line in axes.lines if y < line.get_ydata()[0] < y + 1]
            expected = [100 * _row(scores, method, n)[f"normalized_{key}"] for n in (5, 10)]
            assert [line.get_xdata()[0] for line in others] == pytest.approx(expected)
            assert {line.get_markerfacecolor() for line in others} == {"white"}
        # those far below are named at the edge
        texts = [text.get_text() for text in axes.texts]
        assert len(texts) == len(methods) - len(near)
        numbers = [f"{100 * _row(scores, 'random', n)[f'normalized_{key}']:.0f}" for n in (1, 5, 10)]
        assert "◂ " + " · ".join(numbers) in texts
        # the axis above tells undivided shares: the oracle's is 90 %
        (above,) = axes.child_axes
        assert above.get_xlim() == pytest.approx((0.9 * low, 0.9 * high))
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["best view", "best 5 views", "best 10 views", "oracle", "beyond the axis, N = 1, 5, 10"]
    _assert_draws(figure, tmp_path)


def test_groups_of_methods_are_set_apart() -> None:
    figure = score_figure(make_scores())
    labels = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    steps = np.diff(figure.axes[0].get_yticks())
    assert [labels[row + 1] for row in np.flatnonzero(steps > 1.1)] == [
        "random", "Fisher, min. eigenvalue, exact", "probe: worst trace",
    ]  # fmt: skip


def test_older_tables_and_perfect_methods_are_drawn(tmp_path: Path) -> None:
    scores = older(make_scores(FEW, reference="", top_n=(5,)))
    perfect = scores["method"] != "random"
    for key in KEYS:
        scores.loc[perfect, [f"normalized_{key}", f"normalized_low_{key}", f"normalized_high_{key}"]] = 1.0
    figure = score_figure(scores.drop(columns="occlusion"))
    (mark,) = _marks(figure.axes[0], "bins")
    assert mark.get_xdata() == [100]
    low, high = figure.axes[0].get_xlim()
    assert low < 98 and high > 100.1
    _assert_draws(figure, tmp_path)
    with pytest.raises(ValueError, match="no regret"):
        regret_figure(scores)


def test_figures_show_the_first_candidates_and_occlusion() -> None:
    scores = make_scores(FEW, "mlp-2d")
    worse = make_scores(FEW, "mlp-2d", seed=1)
    both = pd.concat([scores, worse.assign(candidates="best 100"), worse.assign(occlusion="none")], ignore_index=True)
    for draw in (score_figure, regret_figure):
        for one, other in zip(draw(scores).axes, draw(both).axes, strict=True):
            for mine, theirs in zip(one.lines, other.lines, strict=True):
                np.testing.assert_array_equal(mine.get_xydata(), theirs.get_xydata())


def test_regret_figure_tells_losses_and_differences(tmp_path: Path) -> None:
    scores = make_scores()
    figure = regret_figure(scores)
    regret, difference = figure.axes
    assert regret.get_title() == "regret: oracle minus method"
    assert difference.get_title() == "method minus MLP, 2d + 3d"
    for axes, name in ((regret, "regret"), (difference, "difference")):
        assert [*axes.lines[0].get_xdata()] == [0, 0]
        for method in ("bins", "mlp-2d", "fisher-logdet-quadratic"):
            row = _row(scores, method, 1)
            (mark,) = _marks(axes, method)
            assert mark.get_xdata() == pytest.approx([100 * row[f"{name}_{KEYS[0]}"]])
            ends = [100 * row[f"{name}_{end}_{KEYS[0]}"] for end in ("low", "high")]
            assert _whisker(axes, mark.get_ydata()[0]) == pytest.approx(ends)
    assert _marks(difference, "mlp-2d+3d")[0].get_xdata() == [0]
    numbers = " · ".join(f"{100 * _row(scores, 'forward', n)[f'regret_{KEYS[0]}']:.0f}" for n in (1, 5, 10))
    assert f"{numbers} ▸" in [text.get_text() for text in regret.texts]
    assert any(text.get_text().startswith("◂ −") for text in difference.texts)
    assert "within 5 cm, 0.4°" in figure.get_supxlabel()
    _assert_draws(figure, tmp_path)


def test_regret_figure_without_a_reference_has_one_panel(tmp_path: Path) -> None:
    figure = regret_figure(make_scores(FEW, reference=""))
    assert len(figure.axes) == 1
    _assert_draws(figure, tmp_path)


def test_calibration_figure_draws_the_curves(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    parts = []
    for method, temperature in (("mlp-2d", 2.0), ("mlp-2d+3d", float("nan"))):
        probability = rng.random(500)
        rows = calibration_rows(probability, rng.random(500) < probability, temperature)
        parts.append(rows.assign(method=method, temperature=temperature))
    table = pd.concat(parts, ignore_index=True)
    figure = calibration_figure(table)
    curves, counts = figure.axes[:2], figure.axes[2:]
    assert [axes.get_title() for axes in curves] == ["MLP, 2d", "MLP, 2d + 3d"]
    assert [len(axes.lines) for axes in curves] == [3, 2]  # with the diagonal; one has no temperature
    np.testing.assert_array_equal(curves[0].lines[0].get_xydata(), [[0, 0], [1, 1]])
    for line, patch, when in zip(curves[0].lines[1:], counts[0].patches, ("before", "after"), strict=True):
        rows = table[(table["method"] == "mlp-2d") & (table["when"] == when)]
        known = rows[rows["n"] > 0]
        np.testing.assert_allclose(line.get_xydata(), known[["mean_predicted", "share_good"]])
        np.testing.assert_array_equal(patch.get_data().values, rows["n"])
        assert f"ECE {rows['ece'].iloc[0]:.3f}" in str(line.get_label())
    assert str(curves[0].lines[2].get_label()).startswith("T = 2.00")
    _assert_draws(figure, tmp_path)


def _row(scores: pd.DataFrame, method: str, n: int) -> pd.Series:
    rows = scores[(scores["method"] == method) & (scores["scene"] == "all")]
    return rows[rows["top_n"] == n].iloc[0]


def _marks(axes: Axes, method: str) -> list[Line2D]:
    return [line for line in axes.lines if line.get_label() == method_style(method).label]


def _whisker(axes: Axes, y: float) -> list[float]:
    segments = [segment for lines in axes.collections for segment in lines.get_segments()]
    (found,) = (segment for segment in segments if np.allclose(segment[:, 1], y))
    return [float(value) for value in found[:, 0]]


def _assert_draws(figure: Figure, folder: Path) -> None:
    save_figure(figure, folder / "figure.png")
    image = imread(folder / "figure.png")
    assert image.shape[0] > 300
    assert image.std() > 0.01
