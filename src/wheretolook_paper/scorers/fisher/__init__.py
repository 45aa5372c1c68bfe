"""Fisher information of the pose (Zhang and Scaramuzza, Fisher Information Field, 2020): the paper's nine rows, and two
probes of the field that its tables list among them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from wheretolook.scorers.registry import BuildOptions, Method, MethodStyle, imported, no_params

if TYPE_CHECKING:
    from wheretolook.geometry.camera import Camera
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.scorers.base import Scorer

Approximation = Literal["exact", "quadratic", "gp"]

METRICS = {"mineig": ("min. eigenvalue", "P"), "logdet": ("log det", "X"), "trace": ("trace", "h")}
"""Metrics of the information: label, marker."""

APPROXIMATIONS: dict[Approximation, tuple[str, str, Any]] = {
    "exact": ("exact", "#5E2750", "-"),
    "quadratic": ("quadratic", "#B65C93", (0, (5, 1))),
    "gp": ("GP", "#DDA3C6", (0, (2, 1))),
}
"""Approximations of the sum over landmarks: label, shade of one colour (the exact one darkest), line style."""


def _metric(metric: str, approximation: Approximation, about_origin: bool) -> Method:
    def build(localization_map: LocalizationMap, options: BuildOptions) -> Scorer:
        from wheretolook_paper.scorers.fisher.score import FisherScorer

        return FisherScorer(localization_map, metric, approximation, about_origin)

    def params(camera: Camera) -> dict[str, Any]:
        from wheretolook_paper.fisher.soft_visibility import GaussianProcessVisibility, cone_half_angle

        process = GaussianProcessVisibility.fitted(cone_half_angle(camera))
        factors = {"gp_factors": process.n_factors, "gp_length": round(process.length, 4)}
        return {**factors, "gp_held_out_rmse": round(process.held_out_error(), 4)}

    (name, marker) = METRICS[metric]
    (kind, color, dashes) = APPROXIMATIONS[approximation]
    about = ", turned about the world's origin (only if named)" if about_origin else ""
    label = f"Fisher, {name}, {kind}" + (", about the origin" if about_origin else "")
    return Method(
        name=f"fisher-{metric}-{approximation}" + ("-origin" if about_origin else ""),
        about=f"A metric of the information that a view has on its own pose: {metric}, {approximation}{about}.",
        style=MethodStyle(label, color, marker, dashes),
        group="Fisher",
        build=build,
        position=50,
        family="fisher",
        only_if_named=about_origin,
        of_the_few=(metric, approximation, about_origin) == ("trace", "exact", False),
        params=params if approximation == "gp" else no_params,
    )


def _probe(name: str, scorer: str, about: str, style: MethodStyle) -> Method:
    def build(localization_map: LocalizationMap, options: BuildOptions) -> Scorer:
        built: Scorer = imported(f"wheretolook_paper.scorers.fisher.score:{scorer}")(localization_map)
        return built

    return Method(f"fisher-{name}-trace", about, style, "probes", build, position=50)


METHODS = (
    *(
        _metric(metric, approximation, about_origin)
        for about_origin in (False, True)
        for metric in METRICS
        for approximation in APPROXIMATIONS
        if not about_origin or metric != "logdet"  # which is the same about any point
    ),
    _probe(
        "worst",
        "WorstTraceScorer",
        'The view with the least trace by the quadratic field ("trace app worst"): what the field says not to do.',
        MethodStyle("probe: worst trace", "#4D4D4D", "1", (0, (1, 2))),
    ),
    _probe(
        "stationary",
        "StationaryTraceScorer",
        "The stationary point of the quadratic field's trace (\"trace app zero deriv\"), which is its minimum's side.",
        MethodStyle("probe: stationary trace", "#7A7A7A", "2", (0, (1, 3))),
    ),
)
