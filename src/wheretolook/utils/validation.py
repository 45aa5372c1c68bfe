"""Checks of options: each raises a ConfigError that names the option and its value."""

from __future__ import annotations

from collections.abc import Iterable
from math import degrees, inf, pi
from typing import Any

from wheretolook.utils.errors import ConfigError


def check_positive(name: str, value: float) -> None:
    """Raise ConfigError unless a number is positive and finite."""
    if not 0 < value < inf:
        raise ConfigError(f"{name} must be positive and finite", value=value)


def check_range(name: str, value: float, low: float, high: float = inf) -> None:
    """Raise ConfigError unless a number is within [low, high] and finite."""
    if not (low <= value <= high and value < inf):
        limits = f"at least {low:g}" if high == inf else f"within {low:g} and {high:g}"
        raise ConfigError(f"{name} must be {limits}", value=value)


def check_limits(name: str, limits: Any) -> tuple[float, float]:
    """Return two numbers, the lowest and the highest. Raises ConfigError for anything else."""
    try:
        low, high = map(float, limits)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{name} are two numbers", value=limits, fix="Such as (-30, 30).") from error
    return low, high


def check_pitch(name: str, limits: tuple[float, float]) -> None:
    """Raise ConfigError unless limits are a lowest and a highest pitch in degrees, or if they seem to be radians."""
    low, high = check_limits(name, limits)
    largest = max(abs(low), abs(high))
    radians = f"{name} is in degrees: for radians give {degrees(low):.0f} {degrees(high):.0f}, for level views -10 10"
    reject(
        (not (abs(low) <= 90 and abs(high) <= 90), f"{name} must be within -90 and 90 degrees", limits),
        (low > high, f"the lowest {name} comes before the highest: give {high:g} {low:g}", limits),
        (0 < largest <= pi / 2, radians, limits),
    )


def check_choice(name: str, value: object, choices: Iterable[object]) -> None:
    """Raise ConfigError unless a value is one of several."""
    known = [*choices]
    if value not in known:
        raise ConfigError(f"unknown {name}", value=value, fix=f"Use one of {', '.join(map(str, known))}.")


def reject(*cases: tuple[bool, str, object]) -> None:
    """Raise ConfigError with the problem and the value of the first case that holds."""
    for holds, problem, value in cases:
        if holds:
            raise ConfigError(problem, value=value)
