"""Names and styles of methods in figures and tables, the order of tables, and which weights a release ships."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import pandas as pd

from wheretolook.evaluation.results import ORACLE
from wheretolook.scorers.registry import find

Group = Literal["learned", "rules", "Fisher", "probes"]
"""Groups of methods in figures. Probes test a Fisher field: they choose the views that it ranks last."""


@dataclass(frozen=True)
class MethodStyle:
    """How a method is named and drawn."""

    label: str  # display name
    color: str = "#7F3C8D"  # from the palette of Okabe and Ito (2008), or a shade of one of its colours
    marker: str = "3"  # Matplotlib marker
    dashes: Any = (0, (2, 1))  # Matplotlib line style
    group: Group = "rules"
    summary: bool = False  # whether summary figures show it: of a family, the first that is evaluated


def _fisher_styles() -> Iterator[tuple[str, MethodStyle]]:
    """Yield the styles of metrics by their approximations: shades of one colour, the exact one darkest."""
    metrics = {"mineig": ("min. eigenvalue", "P"), "logdet": ("log det", "X"), "trace": ("trace", "h")}
    approximations: dict[str, tuple[str, str, Any]] = {
        "exact": ("exact", "#5E2750", "-"),
        "quadratic": ("quadratic", "#B65C93", (0, (5, 1))),
        "gp": ("GP", "#DDA3C6", (0, (2, 1))),
    }
    for suffix, about in (("", ""), ("-origin", ", about the origin")):
        for metric, (name, marker) in metrics.items():
            if suffix and metric == "logdet":  # the same about any point
                continue
            for approximation, (kind, color, dashes) in approximations.items():
                label = f"Fisher, {name}, {kind}{about}"
                summary = (metric, approximation, suffix) == ("trace", "exact", "")
                style = MethodStyle(label, color, marker, dashes, "Fisher", summary)
                yield f"fisher-{metric}-{approximation}{suffix}", style


_DOTS = (0, (3, 1))

STYLES = {
    "random": MethodStyle("random", "#999999", "x", ":", summary=True),
    "forward": MethodStyle("forward", "#6B6B6B", ">", (0, (6, 2))),
    "visible": MethodStyle("most visible landmarks", "#E69F00", "s", "--"),
    "bins": MethodStyle("reprojections with bins", "#009E73", "D", "-.", summary=True),
    "max-visibility": MethodStyle("max visibility (ActLoc)", "#8F8500", "<", (0, (4, 1, 1, 1))),
    "max-visibility-swapped": MethodStyle(
        "max visibility, angles swapped (as shipped)", "#D6CA1E", "d", (0, (4, 1, 1, 1, 1, 1))
    ),
    **dict(_fisher_styles()),
    "fisher-worst-trace": MethodStyle("probe: worst trace", "#4D4D4D", "1", (0, (1, 2)), "probes"),
    "fisher-stationary-trace": MethodStyle("probe: stationary trace", "#7A7A7A", "2", (0, (1, 3)), "probes"),
    "mlp-2d": MethodStyle("MLP, 2d", "#56B4E9", "v", (0, (5, 1)), "learned", True),
    "mlp-2d+z": MethodStyle("MLP, 2d + z", "#0072B2", "^", (0, (3, 1, 1, 1)), "learned", True),
    "mlp-2d+3d": MethodStyle("MLP, 2d + 3d", "#D55E00", "o", "-", "learned", True),
    "mlp-2d+3d+landmark": MethodStyle("MLP, 2d + 3d + landmark", "#8C3A00", "H", (0, (6, 1, 1, 1)), "learned", True),
    "mlp-released": MethodStyle("MLP, trained as the released code", "#F0A070", "p", (0, (2, 2)), "learned", True),
    "matchability": MethodStyle("matchability", "#CC79A7", "8", (0, (1, 1)), "learned"),
    "expected-inliers": MethodStyle("expected inliers", "#44AA99", "s", _DOTS, "learned"),
    "expected-bins": MethodStyle("expected bins", "#117733", "D", _DOTS, "learned"),
    "fisher-mineig-expected": MethodStyle("Fisher, min. eigenvalue, expected", "#332288", "P", _DOTS, "Fisher"),
    "fisher-logdet-expected": MethodStyle("Fisher, log det, expected", "#332288", "X", _DOTS, "Fisher"),
    "fisher-trace-expected": MethodStyle("Fisher, trace, expected", "#332288", "h", _DOTS, "Fisher"),
    "trees": MethodStyle("boosted trees, landmark attributes", "#882255", "*", "-", "learned"),
    "conv": MethodStyle("convolutional, landmark attributes", "#AA4499", "8", _DOTS, "learned"),
    "set": MethodStyle("set of landmarks", "#CC3311", "o", "-", "learned", True),
    "sphere": MethodStyle("whole sphere (manner of ActLoc)", "#6699CC", "H", _DOTS, "learned"),
    "adapted": MethodStyle("adapted to the scene", "#882255", "P", "-", "learned"),
    ORACLE: MethodStyle("oracle", "#000000", "*", "-"),
}
"""Styles by method, in the order of tables."""

PAPER_NETWORKS = ("mlp-2d", "mlp-2d+z", "mlp-2d+3d")
"""A release ships the best of the paper's network by its inputs, in half precision, beside the best weights of all."""


def may_ship(method: str) -> bool:
    """Whether a release may ship a method's weights as the best of all."""
    return method not in (*PAPER_NETWORKS, "mlp-released")


def method_style(name: str) -> MethodStyle:
    """Return the style of a method; what follows a space in its name, such as a weights file, is added to the label."""
    method, _, further = name.partition(" ")
    known = find(name)
    if known is None and method not in STYLES:
        return MethodStyle(name)
    style = STYLES.get(method) or MethodStyle(method, group="learned" if known and known.weights else "rules")
    return replace(style, label=f"{style.label}, {further}") if further else style


def method_group(name: str) -> Group:
    """Return the group of a method; "rules" for an unknown one."""
    return method_style(name).group


def in_table_order(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of a table with the methods in the order of tables, unknown ones before the oracle."""
    order = {name: number for number, name in enumerate(STYLES)}
    numbers = table["method"].map(lambda name: order.get(name.partition(" ")[0], order[ORACLE]))
    return table.iloc[numbers.argsort(kind="stable")]
