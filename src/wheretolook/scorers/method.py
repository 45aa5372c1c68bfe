"""The record of a method: how it is named, drawn, configured, trained, loaded and built."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from inspect import getdoc
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from wheretolook.geometry.camera import Camera
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.scorers.base import Scorer
    from wheretolook.training.learner import TrainingJob, TrainingResult

Group = Literal["learned", "rules", "Fisher", "probes"]
"""Groups of methods in figures. Probes test a Fisher field: they choose the views that it ranks last."""


@dataclass(frozen=True)
class MethodStyle:
    """How a method is named and drawn in every figure and table."""

    label: str  # display name
    color: str = "#7F3C8D"  # from the palette of Okabe and Ito (2008), or a shade of one of its colours
    marker: str = "3"  # Matplotlib marker
    dashes: Any = (0, (2, 1))  # Matplotlib line style


@dataclass(frozen=True)
class ScorerOptions:
    """What some methods need besides the map."""

    seed: int = 0  # of random methods
    weights: Path | None = None  # of learned methods
    heading: tuple[tuple[float, float, float], ...] = ()  # one direction, a path's waypoints, or none
    anywhere: bool = False  # whether weights adapted to one scene may score in another


def no_params(camera: Camera) -> dict[str, Any]:
    """Return no parameters to log."""
    return {}


@dataclass(frozen=True)
class Method:
    """A method of scoring viewpoints, or a trained model that methods build on.

    A method of this package has its record in a module that `registry.MODULES` names; others are found through the
    entry-point group `wheretolook.methods`. PyTorch and Warp are imported inside the functions given here, so that the
    command line lists methods at once.
    """

    name: str  # in options, tables, runs, and of its weights file
    about: str  # one sentence, for `wheretolook evaluate --list-methods`
    style: MethodStyle
    group: Group = "rules"
    # builds its scorer; weights are given and of the right method if it needs any. None if it scores no views by itself
    build: Callable[[LocalizationMap, ScorerOptions], Scorer] | None = None
    weights: str = ""  # name of the learned method whose weights it scores with; "" if it needs none
    position: int = 1000  # in tables and lists
    family: str = ""  # name that stands for all methods of the family in options
    probability: bool = False  # whether its score is the probability that a view localizes
    is_random_baseline: bool = False  # whether it is a random baseline, evaluated by its exact expectation
    only_if_named: bool = False  # whether an evaluation includes it only by name
    of_the_few: bool = False  # whether summary figures show it: of a family, the first that is evaluated
    reference: int = 0  # of the learned methods evaluated, the highest is the one others are compared with
    learn: Callable[[TrainingJob], TrainingResult] | None = None  # trains it
    config: type | None = None  # frozen dataclass of its training options, with defaults
    folder: str = ""  # group of these options in `train`; methods with the same folder share them
    settings: Mapping[str, Any] = field(default_factory=dict)  # options it overrides
    trained_unasked: bool = False  # whether the train command trains it by default
    one_place: bool = False  # whether its weights serve only the scene that they were adapted to
    one_camera: bool = False  # whether its weights serve only the field of view of their training views
    # whether a release may ship it: as the best of all, as the paper's network (in half precision), or never
    ships: Literal["best", "network", "never"] = "best"
    params: Callable[[Camera], dict[str, Any]] = no_params  # logged by an evaluation, by the camera


def rule(scorer: type[Scorer], style: MethodStyle, **fields: Any) -> Method:
    """Return the record of a method that is built from a map alone, described by its class's docstring."""
    about = " ".join((getdoc(scorer) or "").partition("\n\n")[0].split())
    return Method(scorer.name, about, style, **{"build": lambda map, options: scorer(map), **fields})


def imported(reference: str) -> Callable[..., Any]:
    """Return the function or class `module:name`, imported when called: PyTorch takes seconds to load."""
    return lambda *arguments: resolve_name(reference)(*arguments)


def network_scorer(scorer: str, network: str, *methods: str) -> Callable[[LocalizationMap, ScorerOptions], Scorer]:
    """Return a function that builds a scorer from weights of these methods; both classes as in `imported`."""

    def build(localization_map: LocalizationMap, options: ScorerOptions) -> Scorer:
        from wheretolook.training.trained_network import TrainedNetwork

        assert options.weights is not None
        network_class: Any = resolve_name(network)
        trained = TrainedNetwork.load(options.weights, network_class, *methods, device=localization_map.device)
        built: Scorer = resolve_name(scorer)(localization_map, trained)
        return built

    return build
