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

from synthetic_scores import EVERY_METHOD, FISHER, KEYS, make_scores, older
from wheretolook.evaluation.calibration import calibration_rows
from wheretolook.figures.calibration import calibration_figure
from wheretolook.figures.scores import regret_figure, score_figure
from wheretolook.figures.style import save_figure
from wheretolook.scorers.styles import method_style

FEW: tuple[str, ...] = ("random", "visible", "bins", "mlp-2d")
FAR = ("random", "forward", "max-visibility-swapped")


@pytest.mark.parametrize("methods", [EVERY_METHOD, FEW])
def test_score_figure_draws_the_methods_that_matter_best_first(methods: tuple[str, ...], tmp_path: Path) -> None:
    scores = make_scores(methods, reference="")
    figure = score_figure(scores)
    assert [axes.get_title() for axes in figure.axes] == ["within 5 cm, 0.4°", "within 5 m, 10°"]
    column = f"normalized_{KEYS[0]}"
    first = scores[(scores["scene"] == "all") & (scores["top_n"] == 1) & (scores["method"] != "oracle")]
    ordered = first.sort_values(column, ascending=False, kind="stable")["method"]
    fisher = [name for name in ordered if name in FISHER][:3]
    shown = [name for name in ordered if name in fisher or not name.startswith("fisher")]
    labels = [text.get_text().replace("\n", " ") for text in figure.axes[0].get_yticklabels()]
    assert labels == [method_style(method).label for method in shown]
    for axes, key in zip(figure.axes, (KEYS[0], KEYS[-1]), strict=True):
        low, high = axes.get_xlim()
        assert 50 < low < 80 and high > 100
        numbers = [text.get_text() for text in axes.texts[: len(shown)]]
        arrows = axes.texts[len(shown) :]
        for y, method in enumerate(shown):
            row = _row(scores, method, 1)
            (mark,) = _marks(axes, method)
            assert mark.get_xdata() == pytest.approx([100 * row[f"normalized_{key}"]])
            assert numbers[y] == f"{100 * row[f'normalized_{key}']:.1f}"
            ends = [100 * row[f"normalized_{end}_{key}"] for end in ("low", "high")]
            assert _whisker(axes, y) == pytest.approx(ends)
        # those far below are pointed to at the edge
        beyond = [shown.index(method) for method in shown if method in FAR]
        assert [(text.get_text(), text.get_position()) for text in arrows] == [("◂", (low, y)) for y in beyond]
    _assert_draws(figure, tmp_path)


def test_a_table_of_probes_alone_is_drawn(tmp_path: Path) -> None:
    figure = score_figure(make_scores(("fisher-worst-trace",), reference=""))
    assert len(figure.axes[0].get_yticklabels()) == 1
    _assert_draws(figure, tmp_path)


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
    assert regret.get_title().startswith("regret: oracle minus method")
    assert difference.get_title().startswith("method minus MLP, 2d + 3d")
    for axes, name in ((regret, "regret"), (difference, "difference")):
        assert [*axes.lines[-1].get_xdata()] == [0, 0]
        for method in ("bins", "mlp-2d", "visible"):
            row = _row(scores, method, 1)
            (mark,) = _marks(axes, method)
            assert mark.get_xdata() == pytest.approx([100 * row[f"{name}_{KEYS[0]}"]])
            ends = [100 * row[f"{name}_{end}_{KEYS[0]}"] for end in ("low", "high")]
            assert _whisker(axes, mark.get_ydata()[0]) == pytest.approx(ends)
    assert _marks(difference, "mlp-2d+3d")[0].get_xdata() == [0]
    assert f"{100 * _row(scores, 'forward', 1)[f'regret_{KEYS[0]}']:.1f}" in [text.get_text() for text in regret.texts]
    assert {text.get_text() for text in regret.texts} > {"▸"}
    assert {text.get_text() for text in difference.texts} > {"◂"}
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
    curves = figure.axes[:2]
    counts = figure.axes[2:]
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
