"""The figure of a dataset's labels shows the numbers of its summary."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from synthetic_dataset import make_dataset
from wheretolook.figures.labels import SHADES, label_figure
from wheretolook.figures.style import save_figure
from wheretolook.labelling.report import POSITIVE, LabelSummary, label_summary, threshold_sentence
from wheretolook.viewpoints.config import Split
from wheretolook.viewpoints.thresholds import ALL, THRESHOLDS

SPLITS: dict[int, tuple[Split, ...]] = {
    1: ("test",),
    4: ("test", "train", "train", "val"),
    12: ("train",) * 8 + ("val",) * 2 + ("test",) * 2,
}


def summary_of(folder: Path, n_scenes: int) -> LabelSummary:
    dataset = make_dataset(folder, SPLITS[n_scenes], n_locations=6, n_directions=10, n_landmarks=200)
    tables = {scene.name: scene.read_table() for scene in dataset.scenes}
    return label_summary(tables, {scene.name: scene.split for scene in dataset.scenes})


@pytest.fixture(scope="module")
def summary(tmp_path_factory: pytest.TempPathFactory) -> LabelSummary:
    return summary_of(tmp_path_factory.mktemp("labels"), 4)


def by_shade(axes: Axes, size: str) -> list[list[float]]:
    """Sizes of an axes' bars, a list for each threshold."""
    shades = [to_hex(patch.get_facecolor()) for patch in axes.patches]
    return [[getattr(patch, size)() for patch, color in zip(axes.patches, shades, strict=True) if color == shade]
            for shade in SHADES]  # fmt: skip


def test_bars_of_scenes_are_their_shares(summary: LabelSummary) -> None:
    axes = label_figure(summary).axes[0]
    names = [label.get_text() for label in axes.get_yticklabels()]
    assert names == ["scene-0 (test)", "scene-1 (train)", "scene-2 (train)", "scene-3 (val)", ALL]
    rows = summary.shares.iloc[[0, 1, 2, 3, -1]]
    for widths, name in zip(by_shade(axes, "get_width"), POSITIVE, strict=True):
        np.testing.assert_allclose(widths, 100 * rows[name])
    np.testing.assert_allclose(axes.lines[0].get_xdata(), 100 * rows["locations_positive"])
    order = [to_hex(patch.get_facecolor()) for patch in axes.patches[::5]]
    assert order == list(SHADES[::-1])  # the finer are drawn over the coarser
    assert np.diff(axes.get_ylim())[0] < 0


def test_scenes_are_ordered_by_split(summary: LabelSummary) -> None:
    mixed = summary.shares.assign(split=["train", "test", "train", "test", *summary.shares["split"].iloc[4:]])
    axes = label_figure(LabelSummary(**{**vars(summary), "shares": mixed})).axes[0]
    names = [label.get_text().split()[0] for label in axes.get_yticklabels()]
    assert names == ["scene-0", "scene-2", "scene-1", "scene-3", ALL]
    widths = by_shade(axes, "get_width")[0]
    np.testing.assert_allclose(widths, 100 * mixed[POSITIVE[0]].iloc[[0, 2, 1, 3, -1]])


def test_error_panels_add_up_and_mark_the_thresholds(summary: LabelSummary) -> None:
    figure = label_figure(summary)
    found = [summary.errors_m, summary.errors_deg]
    for axes, errors, unit, name in zip(figure.axes[1:3], found, (0, 1), ("position", "rotation"), strict=True):
        heights = [patch.get_height() for patch in axes.patches]  # type: ignore[attr-defined]
        assert sum(heights) == pytest.approx(100)
        n_views = summary.overall["n_views"]
        drawn = np.array(heights[:-1]).reshape(2, -1)
        np.testing.assert_allclose(drawn, 100 * errors[["localized", "disbelieved"]].to_numpy().T / n_views)
        assert heights[-1] == pytest.approx(100 * summary.overall["without_pose"])
        assert axes.patches[-1].get_x() > errors["high"].iloc[-1]  # type: ignore[attr-defined]
        upright = [line.get_xdata()[0] for line in axes.lines if line.get_marker() == "None"]  # type: ignore[index]
        assert upright == [threshold[unit] for threshold in THRESHOLDS]
        assert axes.get_xscale() == "log"
        assert (axes.get_xlabel(), axes.get_ylabel()) == (f"{name} error", "viewpoints (%)")
    assert [text.get_text() for text in figure.axes[1].texts] == ["5 cm", "25 cm", "0.5 m", "5 m"]
    assert [text.get_text() for text in figure.axes[2].texts] == ["0.4°", "2°", "5°", "10°"]


def test_band_panels_draw_the_bands(summary: LabelSummary) -> None:
    figure = label_figure(summary)
    for axes, bands in zip(figure.axes[3:], (summary.by_height, summary.by_visible), strict=True):
        for heights, name in zip(by_shade(axes, "get_height"), POSITIVE, strict=True):
            np.testing.assert_allclose(heights, 100 * bands[name].fillna(0))
        assert [text.get_text() for text in axes.texts] == [f"{number:,}" for number in bands["n_views"]]
        ends = [float(label.get_text().replace(",", "")) for label in axes.get_xticklabels()]
        assert ends == [*bands["low"], bands["high"].iloc[-1]]
        np.testing.assert_allclose(axes.get_xticks(), np.arange(len(bands) + 1) - 0.5)
    assert figure.axes[3].get_xlabel().endswith("(m)")
    assert figure.axes[4].get_xlabel() == "visible landmarks"


@pytest.mark.parametrize("n_scenes", list(SPLITS))
def test_figure_says_it_in_words_and_nothing_overlaps(n_scenes: int, tmp_path: Path) -> None:
    summary = summary_of(tmp_path / "data", n_scenes)
    figure = label_figure(summary)
    assert str(figure.get_supxlabel()).replace("\n", " ") == threshold_sentence(summary)
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts[:2] == ["positive within 5 cm, 0.4°", "positive within 25 cm, 2°"]
    assert len(texts) == 8
    save_figure(figure, tmp_path / "figure.png")
    assert_apart(figure)


def test_figure_without_any_positive() -> None:
    labels = pd.DataFrame({"low": [0.0], "high": [1.0], "n_views": [3], **dict.fromkeys(POSITIVE, 0.0)})
    errors = pd.DataFrame({"low": [0.01, 0.1], "high": [0.1, 1.0], "localized": 0, "disbelieved": 0})
    row = {"scene": "a", "split": "test", "n_views": 3, "without_pose": 1.0, "locations_positive": 0.0}
    shares = pd.DataFrame([row | dict.fromkeys(POSITIVE, 0.0), row | {"scene": ALL, "split": ALL}]).fillna(0.0)
    figure = label_figure(LabelSummary(shares, labels, labels, errors, errors))
    assert figure.axes[1].patches[-1].get_height() == 100  # type: ignore[attr-defined]
    assert str(figure.get_supxlabel()).startswith("No viewpoint")


def assert_apart(figure: Figure) -> None:
    """Names of scenes, ticks, and texts in panels do not touch each other, and the legend touches no panel."""
    figure.canvas.draw()
    legend = figure.legends[0].get_window_extent()
    for axes in figure.axes:
        assert not legend.overlaps(axes.get_tightbbox())  # type: ignore[arg-type]
    texts = [figure.axes[0].get_yticklabels(), *(axes.get_xticklabels() for axes in figure.axes[1:])]
    for labels in [*texts, *(axes.texts for axes in figure.axes)]:
        boxes = [label.get_window_extent() for label in labels]
        for index, box in enumerate(boxes):
            assert not any(box.overlaps(other) for other in boxes[:index]), [label.get_text() for label in labels]
