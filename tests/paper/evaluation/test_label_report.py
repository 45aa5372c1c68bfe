"""Statistics of labels for reports, compared with numbers computed by hand on small tables."""

import numpy as np
import pytest

from labelled_tables import HALL, NAN, SHED, SPLITS
from wheretolook.dataset.viewpoint_table import POSITIVE, pooled_labels
from wheretolook_paper.evaluation.label_report import label_markdown, label_summary


@pytest.fixture
def summary():
    return label_summary(pooled_labels({"hall": HALL, "shed": SHED}, SPLITS))


def test_report_of_both_localizers():
    """By the first RANSAC result one view less is right in the shed; it is left out if a scene lacks these labels."""
    names = ("status", "error_m", "error_deg")
    hall, shed = (scene.assign(**{f"first_{name}": scene[name] for name in names}) for scene in (HALL, SHED))
    shed.loc[0, "first_error_m"] = 3.0
    both, mixed, alone = (
        label_markdown(label_summary(pooled_labels({"hall": one, "shed": other}, SPLITS)))
        for one, other in ((hall, shed), (hall, SHED), (HALL, SHED))
    )
    cells = " ".join(both.split("## By the first RANSAC result")[1].split())
    assert "| shed | test | 0.0 | 0.0 | 0.0 | 50.0 |" in cells
    assert mixed == alone


def test_bands_by_hand(summary):
    height = summary.by_height
    np.testing.assert_allclose(height["low"], [0, 0.5, 1, 1.5, 2, 2.5, 3])  # above the lowest of each scene
    np.testing.assert_allclose(height["high"], height["low"] + 0.5)
    assert list(height["n_views"]) == [5, 3, 0, 0, 0, 0, 2]
    np.testing.assert_allclose(height[POSITIVE[0]], [2 / 5, 0, NAN, NAN, NAN, NAN, 0])
    np.testing.assert_allclose(height[POSITIVE[-1]], [4 / 5, 1 / 3, NAN, NAN, NAN, NAN, 0])
    visible = summary.by_visible
    assert list(visible["low"]) == [0, 1, 10, 30, 100, 300, 1000, 3000]
    assert list(visible["n_views"]) == [1, 3, 0, 2, 1, 1, 1, 1]
    np.testing.assert_allclose(visible[POSITIVE[-1]], [0, 0, NAN, 1 / 2, 1, 1, 1, 1])
