"""Fisher information of the pose (Zhang and Scaramuzza, Fisher Information Field, 2020): the paper's nine rows, and two
probes of the field that its tables list among them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal, get_args

from wheretolook.scorers.registry import BuildOptions, Method, imported

if TYPE_CHECKING:
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.scorers.base import Scorer

Approximation = Literal["exact", "quadratic", "gp"]
"""Approximations of the sum over landmarks."""

METRICS = ("mineig", "logdet", "trace")


def _built(scorer: str, *options: Any) -> Callable[[LocalizationMap, BuildOptions], Scorer]:
    """Return a function that builds a scorer of `score.py` with these options."""
    make = imported(f"wheretolook_paper.scorers.fisher.score:{scorer}")
    return lambda localization_map, _: make(localization_map, *options)


def _metric(metric: str, approximation: Approximation, about_origin: bool) -> Method:
    about = ", turned about the world's origin (only if named)" if about_origin else ""
    return Method(
        name=f"fisher-{metric}-{approximation}" + ("-origin" if about_origin else ""),
        about=f"A metric of the information that a view has on its own pose: {metric}, {approximation}{about}.",
        build=_built("FisherScorer", metric, approximation, about_origin),
        family="fisher",
        only_if_named=about_origin,
    )


METHODS = (
    *(
        _metric(metric, approximation, about_origin)
        for about_origin in (False, True)
        for metric in METRICS
        for approximation in get_args(Approximation)
        if not about_origin or metric != "logdet"  # which is the same about any point
    ),
    Method(
        "fisher-worst-trace",
        'The view with the least trace by the quadratic field ("trace app worst"): what the field says not to do.',
        _built("WorstTraceScorer"),
    ),
    Method(
        "fisher-stationary-trace",
        "The stationary point of the quadratic field's trace (\"trace app zero deriv\"), which is its minimum's side.",
        _built("StationaryTraceScorer"),
    ),
)
