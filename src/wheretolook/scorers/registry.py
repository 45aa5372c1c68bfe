"""All methods, by name: those of this package and those that other packages register."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from wheretolook.scorers.feature_domain import warn_of_features
from wheretolook.scorers.method import Method, ScorerOptions
from wheretolook.utils.errors import CameraError, ConfigError, WeightsError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.scorers.base import Scorer

MODULES = ("random", "forward", "visible", "bins", "mlp", "matchability", "set", "adapted")
"""Modules of `wheretolook.scorers` whose `METHODS` are the package's own, in the order of tables."""

GROUP = "wheretolook.methods"  # entry points of this group give a `Method`, or several, of another package


@cache
def all_methods() -> Mapping[str, Method]:
    """Every method by its name, this package's own first.

    Raises a ConfigError if what another package registers cannot be loaded, is no method, or has the name of another.
    """
    found: dict[str, Method] = {}
    for module in MODULES:
        for method in import_module(f"wheretolook.scorers.{module}").METHODS:
            _add(found, method, f"wheretolook.scorers.{module}")
    for entry in entry_points(group=GROUP):
        for method in _loaded(entry):
            _add(found, method, f"the entry point {entry.name} = {entry.value}")
    return MappingProxyType(dict(sorted(found.items(), key=lambda item: item[1].position)))


def _loaded(entry: EntryPoint) -> Iterable[Method]:
    try:
        given = entry.load()
        methods = [given] if isinstance(given, Method) else list(given)
    except Exception as error:  # whatever a foreign module raises
        problem = f"a method of another package cannot be loaded: {type(error).__name__}: {error}"
        fix = "Mend or uninstall that package."
        raise ConfigError(problem, value=f"{entry.name} = {entry.value}", fix=fix) from error
    for method in methods:
        if not isinstance(method, Method):
            fix = f"The entry point must give a wheretolook.scorers.method.Method, or several, not {type(method)}."
            raise ConfigError("no method", value=f"{entry.name} = {entry.value}", fix=fix)
    return methods


def _add(found: dict[str, Method], method: Method, source: str) -> None:
    if method.name in found or any(method.name == other.family for other in found.values()):
        fix = f"Rename the one of {source}, or uninstall its package."
        raise ConfigError("two methods have the same name", value=method.name, fix=fix)
    if " " in method.name or not method.name:
        raise ConfigError("a method's name is one word", value=method.name, fix=f"Rename the one of {source}.")
    if (method.learn is None) != (method.config is None) or (method.learn is not None and not method.folder):
        fix = f"Complete the one of {source}."
        raise ConfigError("a method that learns needs learn, config and folder", value=method.name, fix=fix)
    found[method.name] = method


def find(name: str) -> Method | None:
    """The method of a table's row, named before any space; None for the oracle, and for what is not installed here."""
    return all_methods().get(name.partition(" ")[0])


def scorers() -> dict[str, Method]:
    """The methods that score views, by name."""
    return {name: method for name, method in all_methods().items() if method.build is not None}


def fallback() -> Method:
    """What scores a viewpoint map where no method is named and there are no weights."""
    return next(method for method in scorers().values() if method.fallback)


def learned() -> dict[str, Method]:
    """What can be trained, by name."""
    return {name: method for name, method in all_methods().items() if method.learn is not None}


def members(name: str, among: Mapping[str, Method]) -> list[Method]:
    """The methods that a name stands for: one, or those of a family; empty if there are none among these."""
    if name in among:
        return [among[name]]
    family = [method for method in among.values() if method.family == name and not method.only_if_named]
    return family if name else []


def methods_named(names: Iterable[str], among: Mapping[str, Method]) -> list[Method]:
    """The methods that names of methods and families stand for, each once, in the order asked for.

    Raises a ConfigError if a name is not known or stands there twice, or there is none.
    """
    names = tuple(names)
    parts = {name: members(name, among) for name in names}
    if not names or not all(parts.values()) or len(parts) < len(names):
        families = dict.fromkeys(method.family for method in among.values() if method.family)
        known = f"There are {', '.join(among)}; families {', '.join(families)}."
        raise ConfigError("methods must be known and named once", value=names, fix=known)
    return list({method.name: method for part in parts.values() for method in part}.values())


def describe_methods() -> dict[str, str]:
    """What each method that scores views is, by its name, in one sentence."""
    return {name: method.about for name, method in scorers().items()}


def check_method(name: str) -> Method:
    """The method of a name; a ConfigError if no method that scores views has it."""
    if name not in scorers():
        raise ConfigError("unknown method", value=name, fix=f"There are {', '.join(scorers())}.")
    return scorers()[name]


def make_scorer(
    name: str,
    localization_map: LocalizationMap,
    seed: int = 0,
    weights: str | Path | None = None,
    heading: tuple[tuple[float, float, float], ...] = (),
    anywhere: bool = False,
) -> Scorer:
    """Build the scorer of a method, or of the member of a family that the weights are of.

    The heading is for "forward": one direction, or the waypoints of a path; empty for one drawn for each location.
    With `anywhere`, weights adapted to one scene score in another.

    Raises:
        ConfigError: there is no such method, or it needs weights.
        WeightsError: the weights are unusable or of another method.
        MapError: the map lacks what the method needs.
    """
    from wheretolook.training.weights import method_of_weights

    methods = members(name, scorers())
    kinds = [method.weights for method in methods]
    if name not in scorers() and (not kinds or "" in kinds or len({*kinds}) < len(kinds)):
        check_method(name)
    if kinds == [""]:
        return build_scorer(methods[0], localization_map, ScorerOptions(seed, None, heading))
    if weights is None:
        raise ConfigError("the method needs weights", value=name, fix="Give a file that the train command wrote.")
    kind = method_of_weights(weights)
    if kind not in kinds:
        fix = f"Give weights of {' or '.join(dict.fromkeys(kinds))}, or train them."
        raise WeightsError(f"these weights are not of {name}", path=weights, value=kind, fix=fix)
    return build_scorer(
        methods[kinds.index(kind)], localization_map, ScorerOptions(seed, Path(weights), heading, anywhere)
    )


def build_scorer(method: Method, localization_map: LocalizationMap, options: ScorerOptions) -> Scorer:
    """Build a scorer; errors name the file of weights."""
    assert method.build is not None
    try:
        scorer = method.build(localization_map, options)
    except CameraError as error:
        others = [name for name, known in scorers().items() if known.weights == name and not known.one_camera]
        fix = f"{error.fix} Weights of {', '.join(others)} serve every camera, as do methods without weights."
        raise CameraError(error.problem, path=options.weights, value=error.value, fix=fix) from None
    except WeightsError as error:
        if error.path is not None or options.weights is None:
            raise
        raise WeightsError(error.problem, path=options.weights, value=error.value, fix=error.fix) from None
    scorer.name = method.name
    if options.weights is not None:
        warn_of_features(localization_map.landmarks.features, options.weights, stacklevel=3)
    return scorer
