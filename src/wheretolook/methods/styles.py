"""How each method is named and drawn, the same in every figure and table."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class MethodStyle:
    """How a method is drawn and named, the same in every figure and table.

    Attributes:
        label: name for people.
        color: from the palette of Okabe and Ito (2008), or a shade of one of its colours.
        marker: Matplotlib marker.
        dashes: Matplotlib line style.
    """

    label: str
    color: str
    marker: str
    dashes: Any


_FISHER_METRICS = {"mineig": ("min. eigenvalue", "P"), "logdet": ("log det", "X"), "trace": ("trace", "h")}
"""Name for people, marker."""


_FISHER_APPROXIMATIONS = {
    "exact": ("exact", "#5E2750", "-"),
    "quadratic": ("quadratic", "#B65C93", (0, (5, 1))),
    "gp": ("GP", "#DDA3C6", (0, (2, 1))),
}
"""Name for people, shade of one colour (the exact one darkest), line style."""


_STYLES = {
    ("oracle", ""): MethodStyle("oracle", "#000000", "*", "-"),
    ("random", ""): MethodStyle("random", "#999999", "x", ":"),
    ("forward", ""): MethodStyle("forward", "#6B6B6B", ">", (0, (6, 2))),
    ("visible", ""): MethodStyle("most visible landmarks", "#E69F00", "s", "--"),
    ("bins", ""): MethodStyle("reprojections with bins", "#009E73", "D", "-."),
    ("max-visibility", ""): MethodStyle("max visibility (ActLoc)", "#8F8500", "<", (0, (4, 1, 1, 1))),
    ("max-visibility-swapped", ""): MethodStyle(
        "max visibility, angles swapped (as shipped)", "#D6CA1E", "d", (0, (4, 1, 1, 1, 1, 1))
    ),
    **{
        ("fisher", f"{metric} {approximation}{about}"): MethodStyle(
            f"Fisher, {name}, {kind}{about.replace(' ', ', about the ')}", color, marker, dashes
        )
        for metric, (name, marker) in _FISHER_METRICS.items()
        for approximation, (kind, color, dashes) in _FISHER_APPROXIMATIONS.items()
        for about in ("", " origin")
    },
    ("fisher-worst-trace", ""): MethodStyle("probe: worst trace", "#4D4D4D", "1", (0, (1, 2))),
    ("fisher-stationary-trace", ""): MethodStyle("probe: stationary trace", "#7A7A7A", "2", (0, (1, 3))),
    ("mlp", "2d"): MethodStyle("MLP, 2d", "#56B4E9", "v", (0, (5, 1))),
    ("mlp", "2d+z"): MethodStyle("MLP, 2d + z", "#0072B2", "^", (0, (3, 1, 1, 1))),
    ("mlp", "2d+3d"): MethodStyle("MLP, 2d + 3d", "#D55E00", "o", "-"),
    ("expected", "inliers"): MethodStyle("expected inliers", "#44AA99", "s", (0, (3, 1))),
    ("expected", "bins"): MethodStyle("expected bins", "#117733", "D", (0, (3, 1))),
    **{
        ("fisher", f"{metric} expected"): MethodStyle(f"Fisher, {name}, expected", "#332288", marker, (0, (3, 1)))
        for metric, (name, marker) in _FISHER_METRICS.items()
    },
    ("set", ""): MethodStyle("set of landmarks", "#CC3311", "o", "-"),
    ("trees", ""): MethodStyle("boosted trees, landmark attributes", "#882255", "*", "-"),
    ("mlp", "2d+3d+landmark"): MethodStyle("MLP, 2d + 3d + landmark", "#8C3A00", "H", (0, (6, 1, 1, 1))),
    ("conv", ""): MethodStyle("convolutional, landmark attributes", "#AA4499", "8", (0, (3, 1))),
    ("sphere", ""): MethodStyle("whole sphere (manner of ActLoc)", "#6699CC", "H", (0, (3, 1))),
    ("mlp", "released"): MethodStyle("MLP, trained as the released code", "#F0A070", "p", (0, (2, 2))),
}


_SPARE = (("#CC79A7", "8", (0, (1, 1))), ("#F0E442", "H", (0, (4, 2))), ("#7F3C8D", "3", (0, (2, 1))))


GROUPS = ("learned", "rules", "Fisher", "probes")
"""Kinds of methods, in the order of figures. Probes are no methods: they choose what a Fisher field says not to."""


_GROUPS = {
    "mlp": "learned",
    "trees": "learned",
    "set": "learned",
    "expected": "learned",
    "conv": "learned",
    "sphere": "learned",
    "fisher": "Fisher",
    "fisher-worst-trace": "probes",
    "fisher-stationary-trace": "probes",
}


def method_group(method: str) -> str:
    """Which of `GROUPS` a method belongs to; one that is not listed is a rule."""
    return _GROUPS.get(method, "rules")


def rows_by_group(methods: Iterable[tuple[str, str]], gap: float = 0.6) -> dict[tuple[str, str], float]:
    """Where rows of methods are drawn, from the top down: in the order of `GROUPS`, then in the order given.

    Args:
        methods: names and inputs.
        gap: between groups, in rows.
    """
    ordered = sorted(methods, key=lambda method: GROUPS.index(method_group(method[0])))
    groups = [method_group(name) for name, _ in ordered]
    new = [0.0] + [gap * (one != other) for one, other in zip(groups[1:], groups, strict=False)]
    return {method: float(row + sum(new[: row + 1])) for row, method in enumerate(ordered)}


def method_style(method: str, inputs: str = "") -> MethodStyle:
    """Style of a method; one that is not listed gets a style that depends on its name alone.

    Args:
        method: name of the scorer.
        inputs: its input variant, "" if it has none.
    """
    known = _STYLES.get((method, inputs))
    if known is not None:
        return known
    label = f"{method}, {inputs}" if inputs else method
    return MethodStyle(label, *_SPARE[sum(label.encode()) % len(_SPARE)])


def scorer_style(name: str) -> MethodStyle:
    """Style of a method by its name on the command line, such as "fisher-trace-gp" or "mlp-2d+z"."""
    if (name, "") in _STYLES:
        return _STYLES[name, ""]
    method, _, inputs = name.partition("-")
    return method_style(method, inputs.replace("-", " "))
