"""Baselines that weight each visible landmark by its learned detection probability."""

from __future__ import annotations

from typing import TYPE_CHECKING

from wheretolook.scorers.method import Method, MethodStyle, ScorerOptions

if TYPE_CHECKING:
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.scorers.base import Scorer


def _expected(kind: str, about: str, style: MethodStyle) -> Method:
    def build(localization_map: LocalizationMap, options: ScorerOptions) -> Scorer:
        from wheretolook_paper.scorers.expected import ExpectedScorer

        assert options.weights is not None
        return ExpectedScorer(localization_map, options.weights, kind)

    return Method(
        f"expected-{kind}", about, style, "learned", build, weights="matchability", family="expected", position=70
    )


def _expected_fisher(metric: str, name: str, marker: str) -> Method:
    def build(localization_map: LocalizationMap, options: ScorerOptions) -> Scorer:
        from wheretolook_paper.scorers.expected import ExpectedFisherScorer

        assert options.weights is not None
        return ExpectedFisherScorer(localization_map, options.weights, metric)

    weighted = "each landmark in view weighted by its learned chance of being found"
    about = f"Expected Fisher information of the pose, {weighted}: {metric}."
    style = MethodStyle(f"Fisher, {name}, expected", "#332288", marker, (0, (3, 1)))
    name = f"fisher-{metric}-expected"
    return Method(name, about, style, "Fisher", build, weights="matchability", family="expected", position=70)


METHODS = (
    _expected(
        "inliers",
        "Landmarks in view, each by its learned chance of being found.",
        MethodStyle("expected inliers", "#44AA99", "s", (0, (3, 1))),
    ),
    _expected(
        "bins",
        "Bins of the image, each by the learned chance that a landmark in it is found.",
        MethodStyle("expected bins", "#117733", "D", (0, (3, 1))),
    ),
    _expected_fisher("mineig", "min. eigenvalue", "P"),
    _expected_fisher("logdet", "log det", "X"),
    _expected_fisher("trace", "trace", "h"),
)
