"""How methods are named and drawn, the same in every figure and table."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import get_args

from wheretolook.methods.method import Group, MethodStyle
from wheretolook.methods.registry import find

ORACLE = "oracle"  # name of what knows the labels and chooses the best there is, in tables and figures
GROUPS: tuple[Group, ...] = get_args(Group)  # in the order of figures

_ORACLE_STYLE = MethodStyle("oracle", "#000000", "*", "-")

_SPARE = (("#CC79A7", "8", (0, (1, 1))), ("#F0E442", "H", (0, (4, 2))), ("#7F3C8D", "3", (0, (2, 1))))
"""Of methods that are not installed here."""


def method_style(name: str) -> MethodStyle:
    """Style of a method. What follows a space in its name, such as a file of weights, is added to the label."""
    if name == ORACLE:
        return _ORACLE_STYLE
    method = find(name)
    if method is None:
        return MethodStyle(name, *_SPARE[sum(name.encode()) % len(_SPARE)])
    further = name.partition(" ")[2]
    return replace(method.style, label=f"{method.style.label}, {further}") if further else method.style


def method_group(name: str) -> Group:
    """Which of `GROUPS` a method belongs to; one that is not known is a rule."""
    method = find(name)
    return "rules" if method is None else method.group


def rows_by_group(methods: Iterable[str], gap: float = 0.6) -> dict[str, float]:
    """Where rows of methods are drawn, from the top down, a gap (in rows) between groups, in the order of `GROUPS`."""
    ordered = sorted(methods, key=lambda method: GROUPS.index(method_group(method)))
    groups = [method_group(name) for name in ordered]
    new = [0.0] + [gap * (one != other) for one, other in zip(groups[1:], groups, strict=False)]
    return {method: float(row + sum(new[: row + 1])) for row, method in enumerate(ordered)}
