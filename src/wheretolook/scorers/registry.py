"""All methods by name: those of this package and those that other packages register."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
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
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.scorers.base import Scorer

MODULES = ("random", "forward", "visible", "bins", "mlp", "matchability", "set", "adapted")
"""Modules of `wheretolook.scorers` whose `METHODS` are the package's own."""

GROUP = "wheretolook.methods"  # entry points of this group are a `Method`, or several, of another package


@cache
def all_methods() -> Mapping[str, Method]:
    """Return every method by its name, in the order of tables.

    Raises a ConfigError if what another package registers cannot be loaded, is no method, or has the name of another.
    """
    methods: dict[str, Method] = {}
    for module in MODULES:
        for method in import_module(f"wheretolook.scorers.{module}").METHODS:
            _add(methods, method, f"wheretolook.scorers.{module}")
    for entry in entry_points(group=GROUP):
        for method in _load(entry):
            _add(methods, method, f"the entry point {entry.name} = {entry.value}")
    return MappingProxyType(dict(sorted(methods.items(), key=lambda item: item[1].position)))


def _load(entry: EntryPoint) -> Iterable[Method]:
    try:
        loaded = entry.load()
        methods = [loaded] if isinstance(loaded, Method) else list(loaded)
    except Exception as error:  # whatever a foreign module raises
        problem = f"a method of another package cannot be loaded: {type(error).__name__}: {error}"
        raise ConfigError(problem, value=f"{entry.name} = {entry.value}", fix="Fix or uninstall it.") from error
    if not all(isinstance(method, Method) for method in methods):
        fix = "The entry point must be one or several wheretolook.scorers.method.Method."
        raise ConfigError("no method", value=f"{entry.name} = {entry.value}", fix=fix)
    return methods


def _add(methods: dict[str, Method], method: Method, source: str) -> None:
    problem = ""
    if method.name in methods or any(method.name == other.family for other in methods.values()):
        problem = "two methods have the same name"
    elif " " in method.name or not method.name:
        problem = "a method's name is one word"
    elif (method.learn is None) != (method.config is None) or (method.learn is not None and not method.folder):
        problem = "a learned method needs learn, config and folder"
    if problem:
        raise ConfigError(problem, value=method.name, fix=f"Change that of {source}, or uninstall its package.")
    methods[method.name] = method


def find(name: str) -> Method | None:
    """Return the method of a table's row, named before any space; None for the oracle and for unknown methods."""
    return all_methods().get(name.partition(" ")[0])


def scorers() -> dict[str, Method]:
    """Return the methods that score views, by name."""
    return {name: method for name, method in all_methods().items() if method.build is not None}


def fallback() -> Method:
    """Return the method of viewpoint maps where neither a method nor weights are given."""
    return next(method for method in scorers().values() if method.fallback)


def learned() -> dict[str, Method]:
    """Return the methods that can be trained, by name."""
    return {name: method for name, method in all_methods().items() if method.learn is not None}


def members(name: str, among: Mapping[str, Method]) -> list[Method]:
    """Return the methods that a name stands for: one, or those of a family; empty for an unknown name."""
    if name in among:
        return [among[name]]
    family = [method for method in among.values() if method.family == name and not method.only_if_named]
    return family if name else []


def methods_named(names: Iterable[str], among: Mapping[str, Method]) -> list[Method]:
    """Return the methods that names of methods and families stand for, each once, in the order of the names.

    Raises a ConfigError if a name is unknown or repeated, or there is none.
    """
    names = tuple(names)
    parts = {name: members(name, among) for name in names}
    if not names or not all(parts.values()) or len(parts) < len(names):
        families = dict.fromkeys(method.family for method in among.values() if method.family)
        known = f"There are {', '.join(among)}; families {', '.join(families)}."
        raise ConfigError("methods must be known and named once", value=names, fix=known)
    return list({method.name: method for part in parts.values() for method in part}.values())


def describe_methods() -> dict[str, str]:
    """Return a sentence on each method that scores views, by its name."""
    return {name: method.about for name, method in scorers().items()}


def check_method(name: str) -> Method:
    """Return the scoring method of a name; a ConfigError if there is none."""
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
        path = error.path or options.weights
        raise WeightsError(error.problem, path=path, value=error.value, fix=error.fix) from None
    scorer.name = method.name
    if options.weights is not None:
        warn_of_features(localization_map.landmarks.features, options.weights, stacklevel=3)
    return scorer
