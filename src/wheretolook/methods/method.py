"""What a method is: one record that says how it is named, drawn, configured, learnt, loaded and scored."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from wheretolook.geometry.camera import Camera
    from wheretolook.inputs.localization_map import LocalizationMap
    from wheretolook.learning.learner import Learnt, Task
    from wheretolook.methods.base import Scorer

Group = Literal["learned", "rules", "Fisher", "probes"]
"""Kinds of methods. Probes are no methods to choose views by: they choose what a Fisher field says not to."""


@dataclass(frozen=True)
class MethodStyle:
    """How a method is named and drawn, the same in every figure and table.

    Attributes:
        label: name for people.
        color: from the palette of Okabe and Ito (2008), or a shade of one of its colours.
        marker: Matplotlib marker.
        dashes: Matplotlib line style.
    """

    label: str
    color: str = "#7F3C8D"
    marker: str = "3"
    dashes: Any = (0, (2, 1))


@dataclass(frozen=True)
class ScorerOptions:
    """What some methods need beside the map.

    Attributes:
        seed: for methods with randomness.
        weights: for methods that score with what was learnt.
        heading: for methods that look where a robot goes: one direction, or the waypoints of a path; empty for one
            drawn for each location.
    """

    seed: int = 0
    weights: Path | None = None
    heading: tuple[tuple[float, float, float], ...] = ()


def no_params(camera: Camera) -> dict[str, Any]:
    """Nothing to log."""
    return {}


@dataclass(frozen=True)
class Method:
    """A method of scoring viewpoints, or something learnt that methods build on.

    A method of this package has its record in a module that `registry.MODULES` names; anybody else's is found by the
    entry-point group `wheretolook.methods`. What imports PyTorch or Warp does so inside the functions given here, so
    that the command line can list methods at once.

    Attributes:
        name: its one name: in options, tables, runs, and that of its weights' file.
        about: one sentence, for `wheretolook evaluate --list-methods`.
        style: how it is named and drawn.
        group: in figures.
        build: makes its scorer from a map and options; of a method that needs weights, these are given and of the right
            kind. None for what scores no views by itself.
        weights: name of the learned method whose weights it scores with; "" if it needs none.
        family: name that stands for all methods of the family where methods are asked for; "" for none.
        probability: whether its score is the probability that a view localizes.
        by_chance: whether it is drawn at random: an evaluation then tells the exact expectation.
        only_if_named: whether an evaluation has it only if it is named.
        reference: of the learned methods evaluated, the one with the highest number is what others are compared with
            unless told otherwise.
        learn: learns it; None for a method that learns nothing.
        config: class of its options, a frozen dataclass whose defaults can be made without arguments.
        folder: name of these options' group in `train`; methods with the same folder share them.
        settings: options that it has whatever its group says.
        trained_unasked: whether the train stage learns it unless told what to learn.
        ships: whether a release may ship it: as the best of all; as the paper's network, of which the best one ships in
            half precision; or not at all, as it is trained to compare with only.
        params: what an evaluation logs about it as parameters, by the camera.
    """

    name: str
    about: str
    style: MethodStyle
    group: Group = "rules"
    build: Callable[[LocalizationMap, ScorerOptions], Scorer] | None = None
    weights: str = ""
    family: str = ""
    probability: bool = False
    by_chance: bool = False
    only_if_named: bool = False
    reference: int = 0
    learn: Callable[[Task], Learnt] | None = None
    config: type | None = None
    folder: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    trained_unasked: bool = False
    ships: Literal["best", "network", "never"] = "best"
    params: Callable[[Camera], dict[str, Any]] = no_params
