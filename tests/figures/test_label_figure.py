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
from wheretolook.dataset.sampling_config import Split
from wheretolook.dataset.thresholds import ALL, THRESHOLDS
from wheretolook.figures.labels import SHADES, label_figure
from wheretolook.figures.style import save_figure
from wheretolook.localization.report import POSITIVE, LabelSummary, label_summary, threshold_sentence

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


ENDS = (POSITIVE[0], POSITIVE[-1])  # the finest and the coarsest, which are drawn


def widths_by_shade(axes: Axes) -> list[list[float]]:
    """Widths of an axes' bars, a list for each threshold."""
    shades = [to_hex(patch.get_facecolor()) for patch in axes.patches]
    return [[patch.get_width() for patch, color in zip(axes.patches, shades, strict=True) if color == shade]  # type: ignore[attr-defined]
            for shade in SHADES]  # fmt: skip


def test_bars_of_scenes_are_their_shares(summary: LabelSummary) -> None:
    axes = label_figure(summary).axes[0]
    names = [label.get_text() for label in axes.get_yticklabels()]
    assert names == ["scene 0 (test)", "scene 1 (train)", "scene 2 (train)", "scene 3 (val)", "all scenes"]
    rows = summary.shares.iloc[[0, 1, 2, 3, -1]]
    for widths, name in zip(widths_by_shade(axes), ENDS, strict=True):
        np.testing.assert_allclose(widths, 100 * rows[name])
    assert [text.get_text() for text in axes.texts] == [f"{100 * share:.0f}" for share in rows[ENDS[0]]]
    order = [to_hex(patch.get_facecolor()) for patch in axes.patches[::5]]
    assert order == list(SHADES[::-1])  # the finer are drawn over the coarser
    assert np.diff(axes.get_ylim())[0] < 0


def test_scenes_are_ordered_by_split(summary: LabelSummary) -> None:
    mixed = summary.shares.assign(split=["train", "test", "train", "test", *summary.shares["split"].iloc[4:]])
    axes = label_figure(LabelSummary(**{**vars(summary), "shares": mixed})).axes[0]
    names = [label.get_text().split(" (")[0] for label in axes.get_yticklabels()]
    assert names == ["scene 0", "scene 2", "scene 1", "scene 3", "all scenes"]
    np.testing.assert_allclose(widths_by_shade(axes)[0], 100 * mixed[POSITIVE[0]].iloc[[0, 2, 1, 3, -1]])


def test_errors_add_up_and_the_thresholds_are_marked(summary: LabelSummary) -> None:
    axes = label_figure(summary).axes[1]
    heights = [patch.get_height() for patch in axes.patches]  # type: ignore[attr-defined]
    assert sum(heights) == pytest.approx(100)
    n_views = summary.overall["n_views"]
    drawn = np.array(heights[:-1]).reshape(2, -1)
    np.testing.assert_allclose(drawn, 100 * summary.errors_m[["localized", "disbelieved"]].to_numpy().T / n_views)
    assert heights[-1] == pytest.approx(100 * summary.overall["without_pose"])
    assert axes.patches[-1].get_x() > summary.errors_m["high"].iloc[-1]  # type: ignore[attr-defined]
    upright = [line.get_xdata()[0] for line in axes.lines]  # type: ignore[index]
    assert upright == [THRESHOLDS[0][0], THRESHOLDS[-1][0]]
    assert axes.get_xscale() == "log"
    assert [text.get_text() for text in axes.texts] == ["5 cm", "5 m"]


@pytest.mark.parametrize("n_scenes", list(SPLITS))
def test_figure_says_it_in_words_and_nothing_overlaps(n_scenes: int, tmp_path: Path) -> None:
    summary = summary_of(tmp_path / "data", n_scenes)
    figure = label_figure(summary)
    assert str(figure.get_supxlabel()).replace("\n", " ") == threshold_sentence(summary)
    legends = [[text.get_text() for text in axes.get_legend().get_texts()] for axes in figure.axes]  # type: ignore[union-attr]
    assert legends == [
        ["within 5 cm, 0.4°", "within 5 m, 10°"],
        ["pose believed", "pose with too few inliers", "no pose"],
    ]
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
    """Names of scenes, ticks, and texts in panels do not touch one another, nor do legends touch their panels."""
    figure.canvas.draw()
    for axes in figure.axes:
        legend = axes.get_legend().get_window_extent()  # type: ignore[union-attr]
        assert not any(legend.overlaps(text.get_window_extent()) for text in axes.texts)
        assert not legend.overlaps(axes.get_window_extent())
    texts = [figure.axes[0].get_yticklabels(), *(axes.get_xticklabels() for axes in figure.axes)]
    for labels in [*texts, *(axes.texts for axes in figure.axes)]:
        boxes = [label.get_window_extent() for label in labels]
        for index, box in enumerate(boxes):
            assert not any(box.overlaps(other) for other in boxes[:index]), [label.get_text() for label in labels]
