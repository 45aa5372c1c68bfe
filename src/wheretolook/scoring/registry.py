"""All methods by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from wheretolook.errors import ConfigError
from wheretolook.localization_map import LocalizationMap
from wheretolook.scoring.base import Scorer
from wheretolook.scoring.bins import BinsScorer
from wheretolook.scoring.random import RandomScorer
from wheretolook.scoring.visible import VisibleScorer


def _learned(localization_map: LocalizationMap, weights: str | Path | None) -> Scorer:
    from wheretolook.scoring.learned import load_scorer  # PyTorch takes seconds to load

    if weights is None:
        raise ConfigError("the method needs weights", value="mlp", fix="Give a file that the train stage wrote.")
    return load_scorer(weights, localization_map)


SCORERS: dict[str, Callable[[LocalizationMap, int, str | Path | None], Scorer]] = {
    "random": lambda localization_map, seed, weights: RandomScorer(localization_map, seed),
    "visible": lambda localization_map, seed, weights: VisibleScorer(localization_map),
    "bins": lambda localization_map, seed, weights: BinsScorer(localization_map),
    "mlp": lambda localization_map, seed, weights: _learned(localization_map, weights),
}
"""How each method is built from a map, a seed and weights."""


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
