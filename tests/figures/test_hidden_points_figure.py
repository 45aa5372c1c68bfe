"""The figure of hidden-point removal shows the curves it is given."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from wheretolook.figures.hidden_points import hidden_points_figure


@pytest.mark.parametrize("scenes", [["house"], ["house", "hall", "shop"]])
def test_means_over_scenes_and_the_best_of_each(scenes: list[str]) -> None:
    radii, rng = [1.0, 10.0, 100.0], np.random.default_rng(0)
    rows = [{"scene": scene, "radius": radius} for scene in scenes for radius in radii]
    curves = pd.DataFrame(rows).assign(**{name: rng.random(len(rows)) for name in ("precision", "recall", "f1")})
    axes = hidden_points_figure(curves, 10.0).axes[0]
    lines = {line.get_label(): line for line in axes.get_lines()}
    for label, column in (("precision", "precision"), ("recall", "recall"), ("F1", "f1")):
        np.testing.assert_allclose(lines[label].get_ydata(), curves.groupby("radius")[column].mean())
        np.testing.assert_allclose(lines[label].get_xdata(), radii)
    if len(scenes) > 1:
        thin = [line for line in axes.get_lines() if line.get_markevery() is not None]
        assert [line.get_markevery() for line in thin] == [
            [int(curves[curves["scene"] == scene]["f1"].to_numpy().argmax())] for scene in sorted(scenes)
        ]
    assert any("default 10" in text.get_text() for text in axes.texts)
