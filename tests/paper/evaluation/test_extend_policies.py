"""Policies of extending maps are compared on the views that both were measured on."""

import numpy as np
import pytest

from paper.release.synthetic_release import extended
from wheretolook_paper.evaluation.extend import difference, outcomes, policies, registrations


def test_policies_are_compared_view_by_view_on_the_maps_of_both():
    table = extended()
    whole = policies(table).set_index("policy")
    assert whole.loc["pairs", ["gain", "gain_low", "gain_high"]].tolist() == pytest.approx(
        [0.2] * 3
    )  # alike in both maps
    assert whole.loc["random", ["gain", "won", "lost"]].tolist() == [0, 0, 0]
    half = outcomes(table[(table["policy"] != "pairs") | (table["seed"] == 0)])
    assert difference(half, "pairs", "random")["views"] == 10 and half["pairs"].isna().sum() == 10
    photographs = registrations(table)
    np.testing.assert_array_equal(photographs["p"], [0.9, 0.2, 0.9, 0.2])
    assert photographs["registered"].tolist() == [True, False] * 2
