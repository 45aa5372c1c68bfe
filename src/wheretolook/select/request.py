"""Which views are asked for: how many, within which pitch, and how far the camera may turn."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral

from wheretolook.looks.selection import MAX_VIEWS
from wheretolook.utils.errors import ConfigError


@dataclass(frozen=True)
class SelectionRequest:
    """Which views are selected at each waypoint.

    Args:
        n: number of best views of each waypoint.
        looks: instead of n, number of views that are chosen to be localized jointly, for a camera that turns there.
        pitch_deg: lowest and highest pitch in degrees, 90 straight up.
        max_turn_deg: greatest rotation between a view and the next, in the order of the waypoints. The views are then
            the sequence with the greatest sum of scores within the limit, exactly.
        max_total_turn_deg: with looks, how far the camera turns in all from the first to the last.
        least_score: with max_turn_deg and looks: where the sequence's view scores less, the waypoint becomes a stop
            with the fewest further looks that reach this score jointly, `looks` in all at most.
        skip: leave out waypoints outside the map or inside geometry.
    """

    n: int = 1
    looks: int | None = None
    pitch_deg: tuple[float, float] | None = None
    max_turn_deg: float | None = None
    max_total_turn_deg: float | None = None
    least_score: float | None = None
    skip: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.n, Integral) or self.n < 1:
            raise ConfigError("n must be a whole number of at least 1", value=self.n)
        if self.looks is not None and not (isinstance(self.looks, Integral) and 1 <= self.looks <= MAX_VIEWS):
            raise ConfigError(f"looks must be a whole number of 1 to {MAX_VIEWS}", value=self.looks)
        if self.pitch_deg is not None and not -90 <= self.pitch_deg[0] <= self.pitch_deg[1] <= 90:
            fix = "Give the lowest and the highest pitch in degrees, such as -30 and 30."
            raise ConfigError("limits on pitch must be within -90 and 90", value=tuple(self.pitch_deg), fix=fix)
        for name in ("max_turn_deg", "max_total_turn_deg"):
            value = getattr(self, name)
            if value is not None and not 0 <= value < float("inf"):
                raise ConfigError(f"{name} must be at least 0 degrees", value=value)
        self._check_combination()

    def _check_combination(self) -> None:
        """Raise ConfigError for options that exclude or need each other."""
        stopping = self.least_score is not None
        if stopping and (self.looks is None or self.max_turn_deg is None):
            fix = "Give looks, the most of a waypoint, and max_turn_deg, the limit between waypoints."
            raise ConfigError("least_score is for further looks along a path", value=self.least_score, fix=fix)
        if stopping and not 0 < (self.least_score or 0) <= 1:
            raise ConfigError("least_score must be a probability above 0", value=self.least_score)
        if stopping and self.max_total_turn_deg is not None:
            raise ConfigError("max_total_turn_deg and least_score exclude each other", value=self.max_total_turn_deg)
        if self.looks is not None and self.n > 1:
            raise ConfigError("n and looks exclude each other", value=(self.n, self.looks))
        if self.looks is not None and self.max_turn_deg is not None and not stopping:
            fix = "Give least_score, below which a waypoint gets further looks; or leave max_turn_deg out."
            raise ConfigError("looks are chosen at each waypoint by itself", value=self.looks, fix=fix)
        if self.looks is None and self.max_total_turn_deg is not None:
            raise ConfigError("max_total_turn_deg needs looks", value=self.max_total_turn_deg)
        if self.max_turn_deg is not None and self.n > 1:
            raise ConfigError("max_turn_deg is for one view of each waypoint", value=self.n, fix="Leave n out.")
