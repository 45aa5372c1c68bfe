"""Baselines that weight each visible landmark by its learned detection probability."""

from __future__ import annotations

from typing import TYPE_CHECKING

from wheretolook.scorers.registry import BuildOptions, Group, Method, MethodStyle

if TYPE_CHECKING:
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.scorers.base import Scorer


def _expected(name: str, kind: str, about: str, style: MethodStyle, group: Group) -> Method:
    def build(localization_map: LocalizationMap, options: BuildOptions) -> Scorer:
        from wheretolook_paper.scorers.expected import ExpectedScorer

        assert options.weights is not None
        return ExpectedScorer(localization_map, options.weights, kind)

    return Method(name, about, style, group, build, weights="matchability", family="expected", position=70)


def _fisher(metric: str, label: str, marker: str) -> Method:
    about = f"Expected Fisher information of the pose, each visible landmark weighted by its probability: {metric}."
    style = MethodStyle(f"Fisher, {label}, expected", "#332288", marker, (0, (3, 1)))
    return _expected(f"fisher-{metric}-expected", metric, about, style, "Fisher")


_INLIERS = "Visible landmarks, each weighted by its learned detection probability."
_BINS = "Image bins, each by the learned probability that a landmark in it is detected."

METHODS = (
    _expected(
        "expected-inliers", "inliers", _INLIERS, MethodStyle("expected inliers", "#44AA99", "s", (0, (3, 1))), "learned"
    ),
    _expected("expected-bins", "bins", _BINS, MethodStyle("expected bins", "#117733", "D", (0, (3, 1))), "learned"),
    _fisher("mineig", "min. eigenvalue", "P"),
    _fisher("logdet", "log det", "X"),
    _fisher("trace", "trace", "h"),
)
