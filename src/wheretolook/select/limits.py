"""What can be asked of views: how many, how far up and down, how far the camera turns. Checked before a map is read."""

from __future__ import annotations

from numbers import Integral

from wheretolook.utils.errors import ConfigError


def check_limits(n: int, pitch_deg: tuple[float, float] | None, max_turn_deg: float | None) -> None:
    """Raise a ConfigError unless these are a number of views, limits on pitch and a limit on turns, in degrees."""
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
