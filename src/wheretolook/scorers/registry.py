"""Methods: their records, and the registry by name."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from inspect import getdoc
from pathlib import Path
from pkgutil import resolve_name
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from wheretolook.training.weights import method_of_weights, read_training
from wheretolook.utils.errors import CameraError, ConfigError, OutOfRangeWarning, WeightsError, did_you_mean
from wheretolook.utils.package import WEIGHTS, or_shipped

if TYPE_CHECKING:
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.scorers.base import Scorer
    from wheretolook.training.learner import TrainingJob, TrainingResult


@dataclass(frozen=True)
class BuildOptions:
    """What some methods need besides the map."""

    seed: int = 0  # of random methods
    weights: Path | None = None  # of learned methods
    heading: tuple[tuple[float, float, float], ...] = ()  # one direction, a path's waypoints, or none
    anywhere: bool = False  # whether weights adapted to one scene may score in another


@dataclass(frozen=True)
class Learner:
    """How a method is trained."""

    learn: Callable[[TrainingJob], TrainingResult]
    config: type  # frozen dataclass of its training options, with defaults
    settings: Mapping[str, Any] = field(default_factory=dict)  # options it overrides


@dataclass(frozen=True)
class Method:
    """A method of scoring viewpoints, or a trained model that methods build on.

    A method of this package has its record in a module that `registry.MODULES` names; others are found through the
    entry-point group `wheretolook.methods`. PyTorch and Warp are imported inside the functions given here, so that the
    command line lists methods at once.
    """

    name: str  # in options, tables, runs, and of its weights file
    about: str  # one sentence, for `wheretolook evaluate --list-methods`
    # builds its scorer; weights are given and of the right method if it needs any. None if it scores no views by itself
    build: Callable[[LocalizationMap, BuildOptions], Scorer] | None = None
    weights: str = ""  # name of the learned method whose weights it scores with; "" if it needs none
    family: str = ""  # name that stands for all methods of a family, which share training options
    probability: bool = False  # whether its score is the probability that a view localizes
    only_if_named: bool = False  # whether an evaluation includes it only by name
    one_camera: bool = False  # whether its weights serve only the field of view of their training views
    learner: Learner | None = None  # of a method that can be trained

    @property
    def folder(self) -> str:
        """Group of its training options, `train.<folder>`."""
        return self.family or self.name


def rule(scorer: type[Scorer], **fields: Any) -> Method:
    """Return the record of a method that is built from a map alone, described by its class's docstring."""
    about = " ".join((getdoc(scorer) or "").partition("\n\n")[0].split())
    return Method(scorer.name, about, **{"build": lambda map, options: scorer(map), **fields})


def imported(reference: str) -> Callable[..., Any]:
    """Return the function or class `module:name`, imported when called: PyTorch takes seconds to load."""
    return lambda *arguments, **options: resolve_name(reference)(*arguments, **options)


def network_scorer(scorer: str, network: str, method: str) -> Callable[[LocalizationMap, BuildOptions], Scorer]:
    """Return a function that builds a scorer from weights of a method; both classes as in `imported`."""

    def build(localization_map: LocalizationMap, options: BuildOptions) -> Scorer:
        from wheretolook.training.trained_network import TrainedNetwork

        assert options.weights is not None
        network_class: Any = resolve_name(network)
        trained = TrainedNetwork.load(options.weights, network_class, method, device=localization_map.device)
        built: Scorer = resolve_name(scorer)(localization_map, trained)
        return built

    return build


MODULES = ("random", "forward", "visible", "bins", "mlp", "set", "adapted")
"""Modules of `wheretolook.scorers` whose `METHODS` are the package's own."""

GROUP = "wheretolook.methods"  # entry points of this group are a `Method`, or several, of another package

FALLBACK = "bins"  # the method of viewpoint maps where neither a method nor weights are given

SUBSTITUTES = dict.fromkeys(("disk", "xfeat", "superpoint", "aliked-n32", "loma-b", "loma-b128"), "aliked")
"""Features whose weights are better than those by SIFT where a map's own features have none: measured on val scenes by
DISK and XFeat (docs/features.md), assumed for SuperPoint."""


@cache
def all_methods() -> Mapping[str, Method]:
    """Return every method by its name, those of other packages last.

    Raises a ConfigError if what another package registers cannot be loaded, is no method, or has the name of another.
    """
    methods: dict[str, Method] = {}
    for module in MODULES:
        for method in import_module(f"wheretolook.scorers.{module}").METHODS:
            methods[method.name] = method
    for entry in entry_points(group=GROUP):
        source = f"{entry.name} = {entry.value}"
        try:
            loaded = entry.load()
            for method in [loaded] if isinstance(loaded, Method) else list(loaded):
                _check(method, methods)
                methods[method.name] = method
        except Exception as error:  # whatever a foreign module raises
            problem = f"a method of another package cannot be used: {type(error).__name__}: {error}"
            raise ConfigError(problem, value=source, fix="Fix or uninstall it.") from error
    return MappingProxyType(methods)


def _check(method: Method, methods: Mapping[str, Method]) -> None:
    """Raise an error if what another package registers is no method, or clashes with the methods before it."""
    if not isinstance(method, Method):
        raise TypeError(f"{method!r} is no wheretolook.scorers.registry.Method")
    if method.name in methods or any(method.name == other.family for other in methods.values()):
        raise ValueError(f"two methods have the name {method.name}")
    if " " in method.name or not method.name:
        raise ValueError(f"a method's name is one word, not {method.name!r}")


def find(name: str) -> Method | None:
    """Return the method of a table's row, named before any space; None for the oracle and for unknown methods."""
    return all_methods().get(name.partition(" ")[0])


def is_probability(name: str) -> bool:
    """Whether the score of a table's row is the probability that a view localizes."""
    return bool(getattr(find(name), "probability", False))


def scorers() -> dict[str, Method]:
    """Return the methods that score views, by name."""
    return {name: method for name, method in all_methods().items() if method.build is not None}


def learned() -> dict[str, Method]:
    """Return the methods that can be trained, by name."""
    return {name: method for name, method in all_methods().items() if method.learner is not None}


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
        near = next((did_you_mean(name, among) for name, part in parts.items() if not part), None)
        known = f"There are {', '.join(among)}; families {', '.join(families)}."
        raise ConfigError("methods must be known and named once", value=names, fix=near or known)
    return list({method.name: method for part in parts.values() for method in part}.values())


def describe_methods() -> dict[str, str]:
    """Return a sentence on each method that scores views, by its name."""
    return {name: method.about for name, method in scorers().items()}


def check_method(name: str) -> Method:
    """Return the scoring method of a name; a ConfigError if there is none."""
    if name not in scorers():
        fix = did_you_mean(name, scorers()) or f"There are {', '.join(scorers())}."
        raise ConfigError("unknown method", value=name, fix=fix)
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
    methods = members(name, scorers())
    kinds = [method.weights for method in methods]
    if name not in scorers() and (not kinds or "" in kinds or len({*kinds}) < len(kinds)):
        check_method(name)
    if kinds == [""]:
        return build_scorer(methods[0], localization_map, BuildOptions(seed, None, heading))
    if weights is None:
        raise ConfigError("the method needs weights", value=name, fix="Give a file that the train command wrote.")
    kind = method_of_weights(weights)
    if kind not in kinds:
        fix = f"Give weights of {' or '.join(kinds)}, or train them."
        raise WeightsError(f"these weights are not of {name}", path=weights, value=kind, fix=fix)
    options = BuildOptions(seed, Path(weights), heading, anywhere)
    return build_scorer(methods[kinds.index(kind)], localization_map, options)


def build_scorer(method: Method, localization_map: LocalizationMap, options: BuildOptions) -> Scorer:
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
        _warn_of_features(localization_map.landmarks.features, options.weights)
    return scorer


def _warn_of_features(of_map: str, weights: Path) -> None:
    """Warn if a map's landmarks have other local features than those the weights were trained on."""
    trained_on = read_training(weights).get("features", ["sift"])
    if not of_map or of_map in trained_on:
        return
    text = f"the weights {weights.name} were trained on maps by {', '.join(trained_on)}, and this map is by {of_map}"
    fix = "docs/features.md has the measured losses; `wheretolook check` measures them on your map"
    better = SUBSTITUTES.get(of_map, of_map)
    if better not in trained_on and or_shipped(f"{WEIGHTS}/{better}").is_dir():
        fix = f"Better weights are bundled, {WEIGHTS}/{better}, and used if none are given; {fix}"
    warnings.warn(f"{text}. {fix}.", OutOfRangeWarning, stacklevel=4)
