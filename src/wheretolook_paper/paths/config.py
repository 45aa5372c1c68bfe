"""Settings of the comparison of methods by planned paths."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from wheretolook.planning.config import FORWARD, MappedLattice, PathConfig, StopConfig
from wheretolook.utils.errors import ConfigError, check_positive, check_range, no_option


@dataclass(frozen=True)
class PathsConfig(MappedLattice):
    """Options of the comparison of methods by planned paths.

    Args:
        in_scenes: names of the scenes; none for all of the test split.
        pairs: starts and goals in each scene.
        seed: seed of the starts and goals.
        min_distance_m: least distance of a goal from its start.
        height_m: range of the heights of starts and goals above the floor.
        methods: methods to compare: forward, the shortest path, and some that score views. See `wheretolook evaluate
            --list-methods`. Scores that are no probabilities enter by their ranks.
        weights: file of weights of a learned method. By default, and for methods of another kind, the best of each
            method in the dataset, or else of those that ship.
        max_turn_deg: greatest rotation from a waypoint to the next along a given path.
        max_error_m: a view is good if it localizes with a smaller error of its position.
        max_error_deg: likewise of its orientation.
        resamples: number of resamples of the pairs for 95 % intervals.
        planner: costs and limits of the paths, time to plan each.
        stops: further views at waypoints with a low score; adds rows "METHOD with stops" for methods whose scores are
            probabilities.
        last_views: views localized as one rig, the current one and those before it; adds rows "METHOD last N together".
            1 for none.
        odometry_m_per_m: standard deviation of the rig's translation along each axis, in metres per metre.
        odometry_deg_per_deg: standard deviation of its rotation, in degrees per degree.
    """

    in_scenes: tuple[str, ...] = ()
    pairs: int = 20
    seed: int = 0
    min_distance_m: float = no_option(3.0)
    height_m: tuple[float, float] = no_option((1.2, 1.6))
    methods: tuple[str, ...] = (FORWARD, "fisher-trace-gp", "set")
    weights: Path | None = None
    max_turn_deg: float = 30.0
    max_error_m: float = no_option(0.25)
    max_error_deg: float = no_option(2.0)
    resamples: int = no_option(2000)
    planner: PathConfig = field(default_factory=PathConfig)
    stops: StopConfig = field(default_factory=StopConfig)
    last_views: int = 1
    odometry_m_per_m: float = 0.01
    odometry_deg_per_deg: float = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("pairs", "min_distance_m", "max_turn_deg", "max_error_m", "max_error_deg", "resamples"):
            check_positive(name, getattr(self, name))
        if not 0 < self.height_m[0] <= self.height_m[1]:
            raise ConfigError("height_m needs a range above 0", value=self.height_m)
        check_range("last_views", self.last_views, 1)
        check_range("odometry_m_per_m", self.odometry_m_per_m, 0, 0.999)
        check_range("odometry_deg_per_deg", self.odometry_deg_per_deg, 0, 0.999)
        if FORWARD not in self.methods or len(set(self.methods)) < len(self.methods):
            raise ConfigError(f'methods need "{FORWARD}" to compare with, and every name once', value=self.methods)

    @property
    def is_joint(self) -> bool:
        """Whether views are localized jointly, which needs the pixels of their matches."""
        return self.stops.looks > 1 or self.last_views > 1
