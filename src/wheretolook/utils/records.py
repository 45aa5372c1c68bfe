"""Reads settings back from records of results."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from wheretolook.utils.errors import ConfigError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")


def from_record(settings: type[T], values: Mapping[str, Any]) -> T:
    """Return settings that `dataclasses.asdict` recorded. Raises ConfigError if a constant had another value."""
    fixed = {field.name for field in dataclasses.fields(settings) if not field.init}
    for name in fixed & {*values}:
        if values[name] != getattr(settings, name):
            fix = f"Make the result again: {name} is {getattr(settings, name)} now."
            raise ConfigError(f"{name} is no longer an option", value=values[name], fix=fix)
    return settings(**{name: value for name, value in values.items() if name not in fixed})
