"""Fisher information of the pose (Zhang and Scaramuzza, Fisher Information Field, 2020): the paper's nine rows, and two
probes of the field that its tables list among them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, get_args

from wheretolook.scorers.registry import BuildOptions, Method, imported

if TYPE_CHECKING:
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.scorers.base import Scorer

Approximation = Literal["exact", "quadratic", "gp"]
"""Approximations of the sum over landmarks."""

METRICS = ("mineig", "logdet", "trace")


def _metric(metric: str, approximation: Approximation, about_origin: bool) -> Method:
    def build(localization_map: LocalizationMap, options: BuildOptions) -> Scorer:
        from wheretolook_paper.scorers.fisher.score import FisherScorer

        return FisherScorer(localization_map, metric, approximation, about_origin)

    about = ", turned about the world's origin (only if named)" if about_origin else ""
    return Method(
        name=f"fisher-{metric}-{approximation}" + ("-origin" if about_origin else ""),
        about=f"A metric of the information that a view has on its own pose: {metric}, {approximation}{about}.",
        build=build,
        family="fisher",
        only_if_named=about_origin,
    )


def _probe(name: str, scorer: str, about: str) -> Method:
    def build(localization_map: LocalizationMap, options: BuildOptions) -> Scorer:
        built: Scorer = imported(f"wheretolook_paper.scorers.fisher.score:{scorer}")(localization_map)
        return built

    return Method(f"fisher-{name}-trace", about, build)


METHODS = (
    *(
        _metric(metric, approximation, about_origin)
        for about_origin in (False, True)
        for metric in METRICS
        for approximation in get_args(Approximation)
        if not about_origin or metric != "logdet"  # which is the same about any point
    ),
    _probe(
        "worst",
        "WorstTraceScorer",
        'The view with the least trace by the quadratic field ("trace app worst"): what the field says not to do.',
    ),
    _probe(
        "stationary",
        "StationaryTraceScorer",
        "The stationary point of the quadratic field's trace (\"trace app zero deriv\"), which is its minimum's side.",
    ),
)
