"""Baselines that weight each visible landmark by its learned detection probability."""

from __future__ import annotations

from typing import TYPE_CHECKING

from wheretolook.scorers.registry import BuildOptions, Method

if TYPE_CHECKING:
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.scorers.base import Scorer


def _expected(name: str, kind: str, about: str) -> Method:
    def build(localization_map: LocalizationMap, options: BuildOptions) -> Scorer:
        from wheretolook_paper.scorers.expected import ExpectedScorer

        assert options.weights is not None
        return ExpectedScorer(localization_map, options.weights, kind)

    return Method(name, about, build, weights="matchability", family="expected")


def _fisher(metric: str) -> Method:
    about = f"Expected Fisher information of the pose, each visible landmark weighted by its probability: {metric}."
    return _expected(f"fisher-{metric}-expected", metric, about)


_INLIERS = "Visible landmarks, each weighted by its learned detection probability."
_BINS = "Image bins, each by the learned probability that a landmark in it is detected."

METHODS = (
    _expected("expected-inliers", "inliers", _INLIERS),
    _expected("expected-bins", "bins", _BINS),
    _fisher("mineig"),
    _fisher("logdet"),
    _fisher("trace"),
)
