"""All methods by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from wheretolook.errors import ConfigError
from wheretolook.localization_map import LocalizationMap
from wheretolook.scoring.base import Scorer
from wheretolook.scoring.bins import BinsScorer
from wheretolook.scoring.fisher import FISHER_METHODS, FisherScorer, StationaryTraceScorer, WorstTraceScorer
from wheretolook.scoring.forward import ForwardScorer
from wheretolook.scoring.max_visibility import MaxVisibilityScorer, SwappedMaxVisibilityScorer
from wheretolook.scoring.random import RandomScorer
from wheretolook.scoring.visible import VisibleScorer


def _learned(localization_map: LocalizationMap, weights: str | Path | None) -> Scorer:
    from wheretolook.scoring.learned import load_scorer  # PyTorch takes seconds to load

    if weights is None:
        raise ConfigError("the method needs weights", value="mlp", fix="Give a file that the train stage wrote.")
    return load_scorer(weights, localization_map)


def _fisher(name: str) -> Callable[[LocalizationMap, int, str | Path | None], Scorer]:
    metric, approximation = FISHER_METHODS[name]
    return lambda localization_map, seed, weights: FisherScorer(localization_map, metric, approximation)


SCORERS: dict[str, Callable[[LocalizationMap, int, str | Path | None], Scorer]] = {
    "random": lambda localization_map, seed, weights: RandomScorer(localization_map, seed),
    "forward": lambda localization_map, seed, weights: ForwardScorer(localization_map),
    "visible": lambda localization_map, seed, weights: VisibleScorer(localization_map),
    "bins": lambda localization_map, seed, weights: BinsScorer(localization_map),
    "max-visibility": lambda localization_map, seed, weights: MaxVisibilityScorer(localization_map),
    "max-visibility-swapped": lambda localization_map, seed, weights: SwappedMaxVisibilityScorer(localization_map),
    **{name: _fisher(name) for name in FISHER_METHODS},
    "fisher-worst-trace": lambda localization_map, seed, weights: WorstTraceScorer(localization_map),
    "fisher-stationary-trace": lambda localization_map, seed, weights: StationaryTraceScorer(localization_map),
    "mlp": lambda localization_map, seed, weights: _learned(localization_map, weights),
}
"""How each method is built from a map, a seed and weights."""

PROBES = ("fisher-worst-trace", "fisher-stationary-trace")
"""Methods that show the worst side of a field; tables show them apart."""


def describe_methods() -> dict[str, str]:
    """What each method of `SCORERS` is, by its name: the first line of its class's docstring."""
    from wheretolook.scoring.learned import LearnedScorer

    scorers: tuple[type[Scorer], ...] = (
        RandomScorer, ForwardScorer, VisibleScorer, BinsScorer, MaxVisibilityScorer, SwappedMaxVisibilityScorer,
        WorstTraceScorer, StationaryTraceScorer, LearnedScorer,
    )  # fmt: skip
    texts = {scorer.name: _first_line(scorer) for scorer in scorers}
    for name, (metric, approximation) in FISHER_METHODS.items():
        texts[name] = f"{_first_line(FisherScorer).removesuffix('.')}: {metric}, {approximation}."
    return {name: texts[name] for name in SCORERS}


def _first_line(scorer: type[Scorer]) -> str:
    return (scorer.__doc__ or "").partition("\n")[0]


def make_scorer(
    name: str, localization_map: LocalizationMap, seed: int = 0, weights: str | Path | None = None
) -> Scorer:
    """Build a method by its name.

    Args:
        name: a key of `SCORERS`.
        localization_map: the map and the camera that will look.
        seed: for methods with randomness.
        weights: for learned methods.

    Raises:
        ConfigError: no such method, or it needs weights.
        WeightsError: the weights cannot be used.
    """
    if name not in SCORERS:
        raise ConfigError("unknown method", value=name, fix=f"There are {', '.join(SCORERS)}.")
    return SCORERS[name](localization_map, seed, weights)
