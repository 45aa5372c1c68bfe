"""Errors a user can act on: each names the file, the value, and the fix. Checks of options that raise them."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable, Mapping
from math import degrees, inf, pi
from os import PathLike
from typing import Any, TypeVar


class WhereToLookError(Exception):
    """Base of all errors on bad input. The command line exits with code 2 on it.

    `problem` is one sentence. `path` is the file or folder, and `value` the value, that it is about, if there is one;
    `fix` is what the user can do.
    """

    def __init__(
        self, problem: str, *, path: str | PathLike[str] | None = None, value: object = None, fix: str | None = None
    ) -> None:
        self.problem = problem
        self.path = path
        self.value = value
        self.fix = fix
        message = problem if path is None else f"{path}: {problem}"
        if value is not None:
            message += f" (got {value!r})"
        if fix is not None:
            message += f". {fix}"
        super().__init__(message)

    def __str__(self) -> str:
        """Return the message; if a file could not be read for lack of permission, that is the message."""
        cause = self.__cause__
        while cause is not None and not isinstance(cause, PermissionError):
            cause = cause.__cause__
        if cause is None or isinstance(self, StorageError):
            return super().__str__()
        return f"{cause.filename or self.path}: Permission denied"


class ConfigError(WhereToLookError):
    """A configuration has an unknown key or a value out of range."""


class SceneError(WhereToLookError):
    """A mesh is missing, empty, untextured, not finite, or leaves no free space."""


class MapError(WhereToLookError):
    """A COLMAP model is missing, empty, unreadable or lacks what a stage needs."""


class TableError(WhereToLookError):
    """A table of viewpoints is missing, truncated or lacks columns or labels."""


class WorkerError(WhereToLookError):
    """A worker process ended before its work was done."""


class StorageError(WhereToLookError):
    """A result cannot be written, or was removed after it was written."""


class InUseError(WhereToLookError):
    """Another process holds the lock on a dataset or a store."""


class TrackingError(StorageError):
    """The MLflow store cannot be used, or something cannot be logged to it."""


class WeightsError(WhereToLookError):
    """Trained weights are missing or do not fit the network or the inputs asked for."""


class CameraError(WeightsError):
    """Weights were trained on views of another camera, and do not apply to this one."""


class MapFormatError(WhereToLookError):
    """A saved viewpoint map is missing, damaged or of another version."""


class MissingRunError(WhereToLookError):
    """A figure needs a run that the tracking store does not have."""


class OutOfRangeWarning(UserWarning):
    """Views are outside the training distribution of a scorer, so that its scores are less reliable."""


class MapWarning(UserWarning):
    """A map is used only in part, or may not be in metres with z up."""


class LockWarning(UserWarning):
    """A file system has no locks, so that two processes may write at once."""


class TrackingWarning(UserWarning):
    """Results are on disk, but are not logged."""


class PoseError(WhereToLookError, ValueError):
    """Poses, locations or directions have the wrong shape, are not finite, or are zero directions."""


class PlanningError(WhereToLookError):
    """There is no path, or no sequence of views along it within the camera's limits."""


def check_positive(name: str, value: float) -> None:
    """Raise ConfigError unless a number is positive and finite."""
    if not 0 < value < inf:
        raise ConfigError(f"{name} must be positive and finite", value=value)


def check_range(name: str, value: float, low: float, high: float = inf) -> None:
    """Raise ConfigError unless a number is within [low, high] and finite."""
    if not (low <= value <= high and value < inf):
        limits = f"at least {low:g}" if high == inf else f"within {low:g} and {high:g}"
        raise ConfigError(f"{name} must be {limits}", value=value)


def check_share(name: str, value: float) -> None:
    """Raise ConfigError unless a number is at least 0 and below 1."""
    if not 0 <= value < 1:
        raise ConfigError(f"{name} must be at least 0 and below 1", value=value)


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


def check_names(what: str, names: Iterable[str], settings: Any, others: Iterable[str] = ()) -> None:
    """Raise ConfigError, with the nearest known name, unless all names are fields of a dataclass or others."""
    known = [*(field.name for field in dataclasses.fields(settings)), *others]
    for name in names:
        if name not in known:
            fix = did_you_mean(name, known) or f"Use {', '.join(known)}."
            raise ConfigError(f"unknown {what}", value=name, fix=fix)


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


T = TypeVar("T")


def from_record(settings: type[T], values: Mapping[str, Any]) -> T:
    """Return settings that `dataclasses.asdict` recorded. Raises ConfigError if a constant had another value."""
    dataclass: Any = settings
    fixed = {field.name for field in dataclasses.fields(dataclass) if not field.init}
    for name in fixed & {*values}:
        if values[name] != getattr(settings, name):
            fix = f"Make the result again: {name} is {getattr(settings, name)} now."
            raise ConfigError(f"{name} is no longer an option", value=values[name], fix=fix)
    return settings(**{name: value for name, value in values.items() if name not in fixed})
