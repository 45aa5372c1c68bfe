"""Which file of weights a method scores with: of those given, or of those that ship."""

from __future__ import annotations

from pathlib import Path

from wheretolook.utils.errors import WeightsError
from wheretolook.utils.shipped import WEIGHTS, or_shipped, shipped


def check_there(given: str | Path | None) -> None:
    """Raise a WeightsError if there is no such file or folder of weights: at once, without reading any."""
    if given is not None and not or_shipped(given).exists():
        raise WeightsError("there are no weights", path=or_shipped(given), fix="Correct the path.")


def weights_of(method: str, given: str | Path | None, features: str = "") -> Path | None:
    """The file of weights that a method scores with, of the file or folder given or of those that ship.

    An empty method stands for that of the best weights; None for a method without any. Of a folder those are preferred
    that have learnt by the features of the map (`wheretolook.scorers.feature_domain.folder_for`).

    Raises a ConfigError if there is no such method, a WeightsError if there are no weights of it, or they cannot be
    read.
    """
    from wheretolook.scorers.feature_domain import folder_for
    from wheretolook.scorers.registry import best_weights, check_method, members, scorers
    from wheretolook.training.weights import method_of_weights

    kinds = {known.weights for known in members(method, scorers()) or ([check_method(method)] if method else [])}
    if "" in kinds:
        return None
    place = shipped(WEIGHTS) if given is None else or_shipped(given)
    if not place.is_dir():
        if not place.is_file():
            raise WeightsError("there are no weights", path=place, fix="Correct the path.")
        return place
    if not method:
        return best_weights(place, features)
    for folder in dict.fromkeys((folder_for(place, features), place)):
        for path in sorted(folder.glob("*.safetensors")):
            if method_of_weights(path) in kinds:
                return path
    fix = "Give a file of weights (--weights), or another method."
    raise WeightsError(f"there are no weights of {method} here", path=place, fix=fix)
