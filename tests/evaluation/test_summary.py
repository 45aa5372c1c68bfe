"""Which methods chose best, in words."""

import numpy as np
import pytest

from synthetic_scores import KEYS, make_scores
from wheretolook.evaluation.results import best_in_words

FINEST = KEYS[0]


@pytest.mark.parametrize("reference", ["", "bins", "visible"])
@pytest.mark.parametrize("good, significant", [(0.62, False), (0.8, True)])
def test_summary_of_significance(reference, good, significant):
    """Against visible, whose share is 0.6; intervals reach 6 points, those of differences 3."""
    table = make_scores(("random", "bins", "visible"), reference or None, (1,), ("a",)).assign(reference=reference)
    shares = table["method"].map({"random": 0.4, "bins": good, "visible": 0.6, "oracle": 0.9})
    difference = shares - {"": np.nan, "bins": good, "visible": 0.6}[reference]
    for name, values, width in (("raw", shares, 0.06), ("difference", difference, 0.03)):
        table[f"{name}_{FINEST}"] = values
        table[f"{name}_low_{FINEST}"] = values - width
        table[f"{name}_high_{FINEST}"] = values + width
    assert ("significantly better" in best_in_words(table)) == significant
