"""One look for every figure: colours that the colour-blind can tell apart, and marks that survive in greyscale."""

from __future__ import annotations

import html
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.errors import ConfigError
from wheretolook.figures.config import KINDS

ONE_COLUMN_IN, TWO_COLUMNS_IN = 3.5, 7.2
"""Widths of figures for one and for two columns of a paper, inches. Their letters are as large as they will be in
print: `PRINT`. Figures for the screen are wider, with the letters of `RC`."""

INK = "#333333"
GRID = "#d9d9d9"

RC: dict[str, Any] = {
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.labelsize": 10,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "lines.linewidth": 1.6,
    "hatch.linewidth": 0.7,
    "figure.dpi": 100,
    "savefig.dpi": 160,
    "savefig.bbox": "tight",
    "svg.hashsalt": "wheretolook",
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
}

PRINT: dict[str, Any] = {
    **RC,
    "font.size": 8,
    "axes.titlesize": 8.5,
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.2,
    "lines.markersize": 4,
    "hatch.linewidth": 0.5,
}
"""`RC` with the letters and lines of a printed column."""


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


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure in this style, independent of pyplot and its global state. Draw in `with context(RC):`."""
    with context(RC):
        return Figure(figsize=(width_in, height_in), layout="constrained")


_NOTE = {"png": "Description", "pdf": "Subject", "svg": "Description"}


def save_figure(figure: Figure, path: Path, note: str = "") -> None:
    """Write a figure, atomically, the same figure as the same bytes; its folder is made when needed.

    Args:
        figure: what to write.
        path: file, whose suffix says what kind: .png, .pdf or .svg, the latter two as vectors.
        note: what to keep in the file's metadata, such as the runs that the figure was made from.

    Raises:
        ConfigError: another kind of file.
    """
    kind = path.suffix[1:].lower()
    if kind not in KINDS:
        raise ConfigError("figures are not written as such files", path=path, fix=f"Use {', '.join(KINDS)}.")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    # without dates and versions
    metadata: dict[str, Any] = {"pdf": {"CreationDate": None, "Creator": None}, "svg": {"Date": None}}.get(kind, {})
    if note:
        metadata[_NOTE[kind]] = note
    with context(RC):
        figure.savefig(partial, format=kind, metadata={**metadata, **({"Software": None} if kind == "png" else {})})
    os.replace(partial, path)


def note_of(path: Path) -> str:
    """What `save_figure` kept in a figure's metadata; empty if nothing.

    Raises:
        ConfigError: another kind of file than PNG, PDF or SVG.
    """
    kind = path.suffix[1:].lower()
    if kind == "png":
        from PIL import Image

        with Image.open(path) as image:
            return str(image.info.get(_NOTE[kind], ""))
    if kind == "svg":
        found = re.search(r"<dc:description>(.*?)</dc:description>", path.read_text(encoding="utf-8"), re.DOTALL)
        return html.unescape(found[1]).strip() if found else ""
    if kind == "pdf":
        subject = re.search(rb"/Subject \((.*?)(?<!\\)\)", path.read_bytes(), re.DOTALL)
        return re.sub(rb"\\(.)", rb"\1", subject[1]).decode("latin-1") if subject else ""
    raise ConfigError("figures are not written as such files", path=path, fix=f"Use {', '.join(KINDS)}.")
