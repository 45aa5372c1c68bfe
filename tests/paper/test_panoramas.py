"""The summary of panoramas against single faces."""

import pandas as pd
import pytest

from wheretolook_paper.studies.panoramas import summarize


def test_right_and_confident_poses_are_counted_by_scene_and_of_all():
    rows = [
        ("a", "panorama", 0.01, 0.1, 0.99), ("a", "panorama", 0.01, 0.5, 0.96), ("b", "panorama", 3.0, 0.1, 0.97),
        ("b", "panorama", 0.05, 0.4, 0.5), ("b", "best", float("inf"), float("inf"), 0.0),
    ]  # fmt: skip
    table = pd.DataFrame(rows, columns=["scene", "method", "error_m", "error_deg", "probability"]).assign(seconds=1.0)
    found = summarize(table).set_index(["scene", "method"])
    assert found.loc[("a", "panorama"), "right"] == 0.5 and found.loc[("b", "best"), "right"] == 0
    everywhere = found.loc[("all", "panorama")]
    assert (everywhere["places"], everywhere["right"], everywhere["confident"]) == (4, pytest.approx(0.5), 3)
    assert (everywhere["right_of_confident"], everywhere["wrong_place_of_confident"]) == (1, 1)
