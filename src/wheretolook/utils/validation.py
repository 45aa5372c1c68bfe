"""Checks of options: each raises a ConfigError that names the option and its value."""

from __future__ import annotations

from collections.abc import Iterable
from math import inf

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
