"""Check values of options, and suggest the nearest allowed one."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable, Mapping
from math import degrees, inf, pi
from typing import TYPE_CHECKING, Any, TypeVar

from wheretolook.utils.errors import ConfigError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


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


def did_you_mean(name: str, names: Iterable[str], prefix: str = "") -> str | None:
    """Return a question that suggests the known name nearest to a wrong one, after a prefix; None if none is near."""
    near = nearest(name, names)
    return near and f"Did you mean {prefix}{near}?"


def nearest(name: str, names: Iterable[str]) -> str | None:
    """Return the known name that a wrong one resembles, or that ends alike in another group; None if none does."""
    known = [*names]
    last = name.rpartition(".")[2]
    same = [other for other in known if other.rpartition(".")[2] == last]
    matches = difflib.get_close_matches(name, same, 1, 0) or difflib.get_close_matches(name, known, 1, 0.6)
    if not matches:
        by_last = {other.rpartition(".")[2]: other for other in reversed(known)}
        matches = [by_last[other] for other in difflib.get_close_matches(last, by_last, 1, 0.75)]
    return matches[0] if matches else None


def no_option(default: Any) -> Any:
    """Return a dataclass field with a default that Python may change and the command line may not."""
    return dataclasses.field(default=default, metadata={"option": False})


T = TypeVar("T", bound="DataclassInstance")


def from_record(settings: type[T], values: Mapping[str, Any]) -> T:
    """Return settings that `dataclasses.asdict` recorded. Raises ConfigError if a constant had another value."""
    fixed = {field.name for field in dataclasses.fields(settings) if not field.init}
    for name in fixed & {*values}:
        if values[name] != getattr(settings, name):
            fix = f"Make the result again: {name} is {getattr(settings, name)} now."
            raise ConfigError(f"{name} is no longer an option", value=values[name], fix=fix)
    return settings(**{name: value for name, value in values.items() if name not in fixed})
