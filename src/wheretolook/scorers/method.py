"""What a method is: one record that says how it is named, drawn, configured, learnt, loaded and scored."""

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
    from wheretolook.training.learner import Learnt, Task

Group = Literal["learned", "rules", "Fisher", "probes"]
"""Kinds of methods. Probes are no methods to choose views by: they choose what a Fisher field says not to."""


@dataclass(frozen=True)
class MethodStyle:
    """How a method is named and drawn, the same in every figure and table."""

    label: str  # name for people
    color: str = "#7F3C8D"  # from the palette of Okabe and Ito (2008), or a shade of one of its colours
    marker: str = "3"  # Matplotlib marker
    dashes: Any = (0, (2, 1))  # Matplotlib line style


@dataclass(frozen=True)
class ScorerOptions:
    """What some methods need beside the map."""

    seed: int = 0  # for methods with randomness
    weights: Path | None = None  # for methods that score with what was learnt
    # for methods that look where a robot goes: one direction, or the waypoints of a path; empty for one drawn for each
    # location
    heading: tuple[tuple[float, float, float], ...] = ()
    anywhere: bool = False  # whether weights that are adapted to one place may score in another


def no_params(camera: Camera) -> dict[str, Any]:
    """Nothing to log."""
    return {}


@dataclass(frozen=True)
class Method:
    """A method of scoring viewpoints, or something learnt that methods build on.

    A method of this package has its record in a module that `registry.MODULES` names; anybody else's is found by the
    entry-point group `wheretolook.methods`. What imports PyTorch or Warp does so inside the functions given here, so
    that the command line can list methods at once.
    """

    name: str  # its one name: in options, tables, runs, and that of its weights' file
    about: str  # one sentence, for `wheretolook evaluate --list-methods`
    style: MethodStyle  # how it is named and drawn
    group: Group = "rules"  # in figures
    # makes its scorer from a map and options; of a method that needs weights, these are given and of the right kind.
    # None for what scores no views by itself
    build: Callable[[LocalizationMap, ScorerOptions], Scorer] | None = None
    weights: str = ""  # name of the learned method whose weights it scores with; "" if it needs none
    position: int = 1000  # in tables and lists; equal ones keep the order in which they are registered
    family: str = ""  # name that stands for all methods of the family where methods are asked for; "" for none
    probability: bool = False  # whether its score is the probability that a view localizes
    by_chance: bool = False  # whether it is drawn at random: an evaluation then tells the exact expectation
    only_if_named: bool = False  # whether an evaluation has it only if it is named
    # whether a figure of a few methods shows it: of a family, the first of those that are evaluated
    of_the_few: bool = False
    fallback: bool = False  # whether a viewpoint map has its scores where no method is named and there are no weights
    # of the learned methods evaluated, the one with the highest number is what others are compared with unless told
    # otherwise
    reference: int = 0
    learn: Callable[[Task], Learnt] | None = None  # learns it; None for a method that learns nothing
    config: type | None = None  # class of its options, a frozen dataclass whose defaults can be made without arguments
    folder: str = ""  # name of these options' group in `train`; methods with the same folder share them
    settings: Mapping[str, Any] = field(default_factory=dict)  # options that it has whatever its group says
    trained_unasked: bool = False  # whether the train stage learns it unless told what to learn
    one_place: bool = False  # whether its weights serve only the map that they were adapted to
    one_camera: bool = False  # whether its weights serve only cameras with the field of view of their training views
    # whether a release may ship it: as the best of all; as the paper's network, of which the best one ships in half
    # precision; or not at all, as it is trained to compare with only
    ships: Literal["best", "network", "never"] = "best"
    # what an evaluation logs about it as parameters, by the camera
    params: Callable[[Camera], dict[str, Any]] = no_params


def rule(scorer: type[Scorer], style: MethodStyle, **fields: Any) -> Method:
    """The record of a method that is built of a map alone, unless `build` is given; its docstring says what it is."""
    about = " ".join((getdoc(scorer) or "").partition("\n\n")[0].split())
    return Method(scorer.name, about, style, **{"build": lambda map, options: scorer(map), **fields})


def imported(reference: str) -> Callable[..., Any]:
    """The function or class `module:name`, imported when called: PyTorch takes seconds to load."""

    def call(*given: Any) -> Any:
        return resolve_name(reference)(*given)

    return call


def network_scorer(scorer: str, network: str, *methods: str) -> Callable[[LocalizationMap, ScorerOptions], Scorer]:
    """Builds a scorer from the weights of a network that serves one of these methods; both classes as in `imported`."""

    def build(localization_map: LocalizationMap, options: ScorerOptions) -> Scorer:
        from wheretolook.training.trained_network import TrainedNetwork

        assert options.weights is not None
        network_class: Any = resolve_name(network)
        trained = TrainedNetwork.load(options.weights, network_class, *methods, device=localization_map.device)
        built: Scorer = imported(scorer)(localization_map, trained)
        return built

    return build
