"""Styles of methods in figures and tables."""

from __future__ import annotations

from dataclasses import replace

from wheretolook.scorers.registry import Group, MethodStyle, find

ORACLE = "oracle"  # the best views by their labels, in tables and figures

_ORACLE_STYLE = MethodStyle("oracle", "#000000", "*", "-")


def method_style(name: str) -> MethodStyle:
    """Return the style of a method; what follows a space in its name, such as a weights file, is added to the label."""
    if name == ORACLE:
        return _ORACLE_STYLE
    method = find(name)
    if method is None:
        return MethodStyle(name)
    further = name.partition(" ")[2]
    return replace(method.style, label=f"{method.style.label}, {further}") if further else method.style


def method_group(name: str) -> Group:
    """Return the group of a method; "rules" for an unknown one."""
    method = find(name)
    return "rules" if method is None else method.group
