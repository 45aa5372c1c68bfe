"""Fits of the bundled parameters find what numbers were drawn from."""

import numpy as np
import pandas as pd
import pytest

from scorers.test_accuracy import MODEL, views
from wheretolook.scorers.set.accuracy import STATISTICS
from wheretolook_paper.studies import fit_accuracy


def test_the_fit_finds_the_model_that_errors_are_drawn_from(monkeypatch):
    rng = np.random.default_rng(3)
    statistics = views(20_000)
    own = rng.uniform(0.01, 0.99, len(statistics))
    place = rng.uniform(size=len(own)) < MODEL.p_right_place(own, statistics)
    noise = rng.normal(size=(len(own), 1)) * [error.deviation for error in MODEL.errors]
    # shrunk, so that no error at the right place exceeds its limits
    errors = np.exp(MODEL.log_errors(statistics) + noise - 12)
    errors[~place] = np.inf
    table = pd.DataFrame(statistics, columns=STATISTICS).assign(
        own=own, scene="one", error_m=errors[:, 0], error_deg=errors[:, 1]
    )
    monkeypatch.setattr(fit_accuracy, "LEAST", (0.0, 0.0))
    found = fit_accuracy.fit(table)
    assert [*found.weights, found.bias] == pytest.approx([*MODEL.weights, MODEL.bias], abs=0.1)
    for error, known in zip(found.errors, MODEL.errors, strict=True):
        assert error.weights == pytest.approx(known.weights, abs=0.03)
        assert (error.bias + 12, error.deviation) == pytest.approx((known.bias, known.deviation), abs=0.1)
