"""Which views a robot will have: options only, so that the command line reads them quickly."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral

from wheretolook.utils.errors import ConfigError, check_limits, check_pitch, check_range, reject


@dataclass(frozen=True, kw_only=True)
class TargetOptions:
    """Where the robot's camera will be, and how it will look.

    Args:
        height_m: heights of the camera above the floor in metres; by default the median height of the mapping cameras.
        pitch_deg: lowest and highest pitch in degrees, 90 straight up.
        pan_deg: lowest and highest yaw in degrees relative to the heading at the places given, positive to its left.
        views: number of target views.
        seed: seed of their yaws.
        skip: leave out places outside the map or inside geometry.
    """

    height_m: tuple[float, ...] = ()
    pitch_deg: tuple[float, float] = (0.0, 0.0)
    pan_deg: tuple[float, float] | None = None
    views: int = 400
    seed: int = 0
    skip: bool = False

    def __post_init__(self) -> None:
        check_pitch("pitch_deg", self.pitch_deg)
        low, high = check_limits("pan_deg", self.pan_deg or (-180.0, 180.0))
        check_range("views", self.views, 1, 100_000)
        bad = [height for height in self.height_m if not 0 < height < 100]
        reject(
            (bool(bad), "a height is in metres above the floor, up to 100", bad[:1]),
            (
                not (-360 <= low < high <= 360 and high - low <= 360),
                "pan_deg is a lowest and a highest yaw",
                (low, high),
            ),
        )


def check_extension(n: int, until: float, least_p: float) -> None:
    """Raise ConfigError for a number of photographs, a share to reach, or a probability out of range."""
    fix = "Ask for at least 1; photographs come in pairs, such as 10."
    if not isinstance(n, Integral) or n < 1:
        raise ConfigError("the number of photographs must be a whole number of at least 1", value=n, fix=fix)
    check_range("until", until, 1e-9, 1)
    check_range("least_p", least_p, 0, 1)
