"""Settings of viewpoint maps and planned paths."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Literal

from wheretolook.geometry.lattices import ViewLattice
from wheretolook.looks.selection import MAX_VIEWS
from wheretolook.scorers.forward import ForwardScorer
from wheretolook.utils.errors import ConfigError, check_choice, check_pitch, check_positive, check_range

FORWARD = ForwardScorer.name
"""The method that needs no map: the shortest path, looking ahead. Others are compared with it."""

MAX_DIRECTIONS = 1 << 16
"""Directions of a viewpoint map at most: their ids are stored in 16 bits."""


@dataclass(frozen=True)
class MappedLattice(ViewLattice):
    """The views that a viewpoint map holds. Raises ConfigError, too, if these are too many directions for it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("the number of directions", self.directions, 1, MAX_DIRECTIONS)


@dataclass(frozen=True)
class PathConfig:
    """What a path costs, and what a camera on it can do.

    The cost of a path is its length, `turn_weight_m` for every radian that the camera turns, and `score_weight` for
    every metre times one less the score of the views along it.

    Args:
        score_weight: metres that a metre on which no view would localize costs in addition to its length. The paper's lambda.
        turn_weight_m: metres that turning by one radian costs.
        pitch_deg: least and greatest pitch of the optical axis, degrees above the horizon.
        max_turn_deg_per_m: degrees that the camera turns at most while it moves by a metre.
        spacing_m: distance of the views along a path.
        time_s: seconds to plan; the path only gets better with time.
    """

    score_weight: float = 3.0
    turn_weight_m: float = 0.1
    pitch_deg: tuple[float, float] = (-40.0, 40.0)
    max_turn_deg_per_m: float = 150.0
    spacing_m: float = 0.2
    time_s: float = 5.0

    def __post_init__(self) -> None:
        low, high = self.pitch_deg
        check_pitch("pitch_deg", self.pitch_deg)
        if low == -90 or high == 90:
            raise ConfigError("pitch_deg must exclude straight down and straight up", value=self.pitch_deg)
        for name in ("max_turn_deg_per_m", "spacing_m", "time_s"):
            check_positive(name, getattr(self, name))
        for name in ("score_weight", "turn_weight_m"):
            check_range(name, getattr(self, name), 0)


@dataclass(frozen=True)
class StopConfig:
    """Stops: where one view is not enough, the camera stops, rotates, and all views there are localized jointly.

    Args:
        looks: greatest number of views at a stop, the path's own included; 1 for no stops.
        least_score: a view that scores less gets a stop. A probability.
    """

    looks: int = 1
    least_score: float = 0.7

    def __post_init__(self) -> None:
        check_range("stops.looks", self.looks, 1, MAX_VIEWS)
        check_positive("stops.least_score", self.least_score)
        check_range("stops.least_score", self.least_score, 0, 1)


@dataclass(frozen=True)
class PlanConfig(MappedLattice):
    """A path to plan, and what to write about it.

    Args:
        scene: name of the scene.
        start: where the path starts: x, y, z in the map's own frame, in metres unless --map is in another unit.
        goal: where it ends.
        out: folder to write; empty for `<data>/<name>/<scene>/path`.
        method: method that scores the views; forward for the shortest path, looking ahead. Empty as for the viewpoint
            map.
        accuracy: as for the viewpoint map, of `method`; excludes stops.
        weights: file of weights, for a learned method; by default the best there are.
        against: further methods to plan by, drawn for comparison. Such as forward and fisher-trace-gp; in `methods.png`.
        film: kind of film to make: gif, mp4 or none.
        rerun: write a recording for the Rerun viewer too. Needs `pip install 'wheretolook[view]'`.
        anywhere: allow weights adapted to another scene.
        planner: costs and limits of the path, time to plan.
        stops: where one view is not enough.
    """

    scene: str = ""
    start: tuple[float, float, float] | None = None
    goal: tuple[float, float, float] | None = None
    out: Path | None = None
    method: str = ""
    accuracy: tuple[float, float] | None = None
    weights: Path | None = None
    against: tuple[str, ...] = ()
    film: Literal["gif", "mp4", "none"] = "gif"
    rerun: bool = False
    anywhere: bool = False
    planner: PathConfig = field(default_factory=PathConfig)
    stops: StopConfig = field(default_factory=StopConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.accuracy is not None and self.stops.looks > 1:
            raise ConfigError("plan.accuracy excludes stops", value=self.accuracy)
        check_choice("plan.film", self.film, ("gif", "mp4", "none"))
        for name in ("start", "goal"):
            point = getattr(self, name)
            if point is not None and not all(map(isfinite, point)):
                raise ConfigError(f"plan.{name} must be finite", value=point)
