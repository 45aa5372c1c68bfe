"""What can be asked of views: how many, how far up and down, how far the camera turns. Checked before a map is read."""

from __future__ import annotations

from numbers import Integral

from wheretolook.looks.selection import MAX_VIEWS
from wheretolook.utils.errors import ConfigError


def check_limits(
    n: int,
    pitch_deg: tuple[float, float] | None,
    max_turn_deg: float | None,
    looks: int | None = None,
    max_total_turn_deg: float | None = None,
    least_score: float | None = None,
) -> None:
    """Raise a ConfigError unless these are a number of views, limits on pitch and a limit on turns, in degrees.

    And of looks chosen together, their number and the limit on their turns in all; or, with a limit on turns between
    waypoints, the score below which a waypoint becomes a stop with further looks.
    """
    if least_score is not None:
        if looks is None or max_turn_deg is None:
            fix = "Give the most looks of a waypoint, and the limit on turns between waypoints."
            raise ConfigError("a least score is for further looks along a path", value=least_score, fix=fix)
        if not 0 < least_score <= 1:
            raise ConfigError("a least score is a probability above 0", value=least_score)
    if looks is not None:
        if not isinstance(looks, Integral) or not 1 <= looks <= MAX_VIEWS:
            raise ConfigError(f"looks of a waypoint are a whole number of 1 to {MAX_VIEWS}", value=looks)
        if n > 1 or (max_turn_deg is not None and least_score is None):
            fix = "Leave out the number of best views, and the limit on turns between waypoints."
            if n == 1:
                fix = (
                    "Give a least score, below which a waypoint of the path gets further looks; or leave the limit out."
                )
            raise ConfigError("looks are chosen together, at each waypoint for itself", value=looks, fix=fix)
        if least_score is not None and max_total_turn_deg is not None:
            fix = "Leave it out: further looks turn no farther than they must."
            raise ConfigError(
                "a limit on turning in all is not for looks along a path", value=max_total_turn_deg, fix=fix
            )
    elif max_total_turn_deg is not None:
        fix = "Say how many looks there are."
        raise ConfigError("a limit on turning in all is for looks chosen together", value=max_total_turn_deg, fix=fix)
    if max_total_turn_deg is not None and not 0 <= max_total_turn_deg < float("inf"):
        raise ConfigError("a limit on turning in all is degrees of at least 0", value=max_total_turn_deg)
    if not isinstance(n, Integral) or n < 1:
        raise ConfigError("views of a waypoint are a whole number of at least 1", value=n)
    if max_turn_deg is not None and n > 1:
        fix = "Ask for one view, or leave the limit out."
        raise ConfigError("a limit on turns is for one view of each waypoint", value=n, fix=fix)
    if max_turn_deg is not None and not max_turn_deg >= 0:
        raise ConfigError("a limit on turns is at least 0 degrees", value=max_turn_deg)
    if pitch_deg is not None and not -90 <= pitch_deg[0] <= pitch_deg[1] <= 90:
        fix = "Give the lowest and the highest pitch in degrees, such as -30 and 30."
        raise ConfigError("the limits on pitch do not lie within -90 and 90", value=tuple(pitch_deg), fix=fix)
