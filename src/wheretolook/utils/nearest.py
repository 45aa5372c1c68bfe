"""Suggests the known name that is nearest to a mistyped one."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


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
