"""Which views are asked for: how many, within which pitch, and how far the camera may turn."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral

from wheretolook.looks.selection import MAX_VIEWS
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.validation import check_limits, check_pitch, check_range, reject


@dataclass(frozen=True)
class SelectionRequest:
    """Which views are selected at each waypoint.

    Args:
        n: number of best views of each waypoint.
        looks: instead of n, number of views that are chosen to be localized jointly, for a camera that turns there.
        pitch_deg: lowest and highest pitch in degrees, 90 straight up.
        pan_deg: lowest and highest yaw in degrees relative to the robot's heading at the waypoint, positive to its left.
        apart_deg: with n, least angle between the best views of a waypoint, in degrees.
        max_turn_deg: greatest rotation between a view and the next, in the order of the waypoints. The views are then
            the sequence with the greatest sum of scores within the limit, exactly.
        max_total_turn_deg: with looks, how far the camera turns in all from the first to the last.
        least_score: with max_turn_deg and looks: where the sequence's view scores less, the waypoint becomes a stop
            with the fewest further looks that reach this score jointly, `looks` in all at most.
        sigma_m: standard deviation in metres of the robot's x and y each: reports the views' expected scores.
        yaw_sigma_deg: the same of its yaw in degrees.
        skip: leave out waypoints outside the map or inside geometry.
    """

    n: int = 1
    looks: int | None = None
    pitch_deg: tuple[float, float] | None = None
    pan_deg: tuple[float, float] | None = None
    apart_deg: float | None = None
    max_turn_deg: float | None = None
    max_total_turn_deg: float | None = None
    least_score: float | None = None
    sigma_m: float | None = None
    yaw_sigma_deg: float | None = None
    skip: bool = False

    def __post_init__(self) -> None:
        check_pitch("pitch_deg", self.pitch_deg or (-90.0, 90.0))
        low, high = check_limits("pan_deg", self.pan_deg or (-180.0, 180.0))
        fix = "Give degrees, the lowest first, such as -60 60, or 150 210 for the back."
        if not (-360 <= low < high <= 360 and high - low <= 360):
            raise ConfigError("pan_deg is a lowest and a highest yaw", value=(low, high), fix=fix)
        joint = self.looks is not None
        in_order = self.max_turn_deg is not None
        stopping = self.least_score is not None
        for name in ("max_turn_deg", "max_total_turn_deg", "sigma_m", "yaw_sigma_deg"):
            check_range(name, getattr(self, name) or 0, 0)
        reject(
            (self.apart_deg is not None and self.n == 1, "apart_deg needs an n of at least 2", self.apart_deg),
            (not 0 <= (self.apart_deg or 0) <= 180, "apart_deg must be 0 to 180", self.apart_deg),
            (not isinstance(self.n, Integral) or self.n < 1, "n must be a whole number of at least 1", self.n),
            (joint and self.looks not in range(1, MAX_VIEWS + 1), f"looks must be 1 to {MAX_VIEWS}", self.looks),
            (stopping and not (joint and in_order), "least_score needs looks and max_turn_deg", self.least_score),
            (stopping and not 0 < (self.least_score or 0) <= 1, "least_score must be above 0, to 1", self.least_score),
            (joint and self.n > 1, "n and looks exclude each other", (self.n, self.looks)),
            (in_order and self.n > 1, "max_turn_deg is for one view of each waypoint: leave n out", self.n),
            (joint and in_order and not stopping, "looks with max_turn_deg need least_score", self.looks),
        )
        if self.max_total_turn_deg is not None and (stopping or not joint):
            problem = "max_total_turn_deg needs looks, and excludes least_score"
            raise ConfigError(problem, value=self.max_total_turn_deg)
