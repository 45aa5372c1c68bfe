"""All methods by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from wheretolook.fisher.metrics import METRICS
from wheretolook.inputs.localization_map import LocalizationMap
from wheretolook.learning.weights import best_weights, weights_kind
from wheretolook.methods.base import Scorer
from wheretolook.methods.bins import BinsScorer
from wheretolook.methods.fisher import (
    FISHER_METHODS,
    ORIGIN_METHODS,
    FisherScorer,
    StationaryTraceScorer,
    WorstTraceScorer,
)
from wheretolook.methods.forward import ForwardScorer
from wheretolook.methods.max_visibility import MaxVisibilityScorer, SwappedMaxVisibilityScorer
from wheretolook.methods.mlp.score import LearnedScorer
from wheretolook.methods.random import RandomScorer
from wheretolook.methods.visible import VisibleScorer
from wheretolook.utils.errors import ConfigError, WeightsError


def _with_weights(name: str) -> Callable[[LocalizationMap, ScorerOptions], Scorer]:
    def build(localization_map: LocalizationMap, options: ScorerOptions) -> Scorer:

        scorer = load_scorer(_given(name, options.weights), localization_map)
        if scorer.name != name:
            fix = f"Give weights of {name}, or train them."
            raise WeightsError(f"these weights are not of {name}", path=options.weights, value=scorer.name, fix=fix)
        return scorer

    return build


def _given(name: str, weights: str | Path | None) -> str | Path:
    if weights is None:
        raise ConfigError("the method needs weights", value=name, fix="Give a file that the train stage wrote.")
    return weights


@dataclass(frozen=True)
class ScorerOptions:
    """What some methods need beside the map; see `make_scorer`."""

    seed: int = 0
    weights: str | Path | None = None
    heading: tuple[tuple[float, float, float], ...] = ()


def _fisher(name: str) -> Callable[[LocalizationMap, ScorerOptions], Scorer]:
    return lambda localization_map, options: FisherScorer(localization_map, *_ALL_FISHER[name])


def _forward(localization_map: LocalizationMap, options: ScorerOptions) -> Scorer:
    heading = None if not options.heading else options.heading[0] if len(options.heading) == 1 else options.heading
    return ForwardScorer(localization_map, heading, options.seed)


def _expected(name: str) -> Callable[[LocalizationMap, ScorerOptions], Scorer]:
    def build(localization_map: LocalizationMap, options: ScorerOptions) -> Scorer:
        from wheretolook.methods.matchability.score import (  # PyTorch takes seconds to load
            ExpectedFisherScorer,
            ExpectedScorer,
        )

        weights = _given(name, options.weights)
        if name in EXPECTED_FISHER_METHODS:
            return ExpectedFisherScorer(localization_map, weights, EXPECTED_FISHER_METHODS[name])
        return ExpectedScorer(localization_map, weights, name.removeprefix("expected-"))

    return build


EXPECTED_FISHER_METHODS = {f"fisher-{metric}-expected": metric for metric in METRICS}
"""Metric of the information that is weighted by the landmarks' chance of being found, by the names of the methods."""

EXPECTED_METHODS = ("expected-inliers", "expected-bins", *EXPECTED_FISHER_METHODS)
"""Methods that weight landmarks by their chance of being found."""

_ALL_FISHER = {**FISHER_METHODS, **ORIGIN_METHODS}

SCORERS: dict[str, Callable[[LocalizationMap, ScorerOptions], Scorer]] = {
    "random": lambda localization_map, options: RandomScorer(localization_map, options.seed),
    "forward": _forward,
    "visible": lambda localization_map, options: VisibleScorer(localization_map),
    "bins": lambda localization_map, options: BinsScorer(localization_map),
    "max-visibility": lambda localization_map, options: MaxVisibilityScorer(localization_map),
    "max-visibility-swapped": lambda localization_map, options: SwappedMaxVisibilityScorer(localization_map),
    **{name: _fisher(name) for name in _ALL_FISHER},
    "fisher-worst-trace": lambda localization_map, options: WorstTraceScorer(localization_map),
    "fisher-stationary-trace": lambda localization_map, options: StationaryTraceScorer(localization_map),
    "mlp": _with_weights("mlp"),
    **{name: _expected(name) for name in EXPECTED_METHODS},
    **{name: _with_weights(name) for name in ("trees", "conv", "set", "sphere")},
}
"""How each method is built from a map and options."""

WEIGHTS_OF = {
    **dict.fromkeys(EXPECTED_METHODS, "matchability"),
    **{name: name for name in ("mlp", "trees", "conv", "set", "sphere")},
}
"""Methods that have learnt, and the kind of weights (`wheretolook.learning.weights.weights_kind`) that each needs."""

OPTIONAL = tuple(ORIGIN_METHODS)
"""Methods that an evaluation has only if it names them: no rows of the paper."""

PROBES = ("fisher-worst-trace", "fisher-stationary-trace")
"""Methods that show the worst side of a field; tables show them apart."""


def describe_methods() -> dict[str, str]:
    """What each method of `SCORERS` is, by its name: the first line of its class's docstring."""
    from wheretolook.methods.conv.score import ConvScorer
    from wheretolook.methods.matchability.score import ExpectedFisherScorer
    from wheretolook.methods.mlp.score import LearnedScorer
    from wheretolook.methods.set.score import SetScorer
    from wheretolook.methods.sphere.score import SphereScorer
    from wheretolook.methods.trees.score import TreesScorer

    scorers: tuple[type[Scorer], ...] = (
        RandomScorer, ForwardScorer, VisibleScorer, BinsScorer, MaxVisibilityScorer, SwappedMaxVisibilityScorer,
        WorstTraceScorer, StationaryTraceScorer, LearnedScorer, TreesScorer, ConvScorer, SetScorer,
        SphereScorer,
    )  # fmt: skip
    texts = {scorer.name: _first_line(scorer) for scorer in scorers}
    for name, (metric, approximation, about_origin) in _ALL_FISHER.items():
        about = ", turned about the world's origin (only if named)" if about_origin else ""
        texts[name] = f"{_first_line(FisherScorer).removesuffix('.')}: {metric}, {approximation}{about}."
    texts["expected-inliers"] = "Landmarks in view, each by its learned chance of being found."
    texts["expected-bins"] = "Bins of the image, each by the learned chance that a landmark in it is found."
    for name, metric in EXPECTED_FISHER_METHODS.items():
        texts[name] = f"{_first_line(ExpectedFisherScorer).removesuffix('.')}: {metric}."
    return {name: texts[name] for name in SCORERS}


def _first_line(scorer: type[Scorer]) -> str:
    return (scorer.__doc__ or "").partition("\n")[0]


def check_method(name: str) -> None:
    """Check that there is a method of a name.

    Raises:
        ConfigError: there is none.
    """
    if name not in SCORERS:
        raise ConfigError("unknown method", value=name, fix=f"There are {', '.join(SCORERS)}.")


def make_scorer(
    name: str,
    localization_map: LocalizationMap,
    seed: int = 0,
    weights: str | Path | None = None,
    heading: tuple[tuple[float, float, float], ...] = (),
) -> Scorer:
    """Build a method by its name.

    Args:
        name: a key of `SCORERS`.
        localization_map: the map and the camera that will look.
        seed: for methods with randomness.
        weights: for learned methods.
        heading: for "forward": one direction, or the waypoints of a path; empty for one drawn for each location.

    Raises:
        ConfigError: no such method, or it needs weights.
        WeightsError: the weights cannot be used.
    """
    check_method(name)
    return SCORERS[name](localization_map, ScorerOptions(seed, weights, heading))


def load_scorer(weights: str | Path, localization_map: LocalizationMap) -> Scorer:
    """The learned scorer of weights for a map: `load_scorer(weights, map).score(cam_from_world)`.

    Args:
        weights: a file that the train stage wrote, in which stands what method it is; or a folder of such files, of
            which the one with the best validation average precision is taken.
        localization_map: what to score views of.

    Raises:
        WeightsError: the file cannot be used, or was trained for another field of view than the map's camera.
        MapError: the map lacks what the method needs.
    """
    from wheretolook.methods.conv.score import ConvScorer
    from wheretolook.methods.set.score import SetScorer
    from wheretolook.methods.sphere.score import SphereScorer
    from wheretolook.methods.trees.score import TreesScorer

    loaders: dict[str, Callable[[str | Path, LocalizationMap], Scorer]] = {
        scorer.name: scorer.load for scorer in (LearnedScorer, TreesScorer, ConvScorer, SetScorer, SphereScorer)
    }
    weights = best_weights(weights) if Path(weights).is_dir() else weights
    kind = weights_kind(weights)
    if kind not in loaders:
        known = f"Give weights of {', '.join(loaders)}."
        raise WeightsError("these weights are not of one scorer", path=weights, value=kind, fix=known)
    return loaders[kind](weights, localization_map)
