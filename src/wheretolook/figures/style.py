"""Shared style of all figures: colour-blind-safe colours, Matplotlib parameters, file output."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.figures import KINDS
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import write_bytes

Style = dict[str, Any]  # keyword arguments of Matplotlib functions

ONE_COLUMN_IN = 3.5
TWO_COLUMNS_IN = 7.2
"""Widths of one-column and two-column figures in print, inches; draw them with `PRINT`."""

INK = "#333333"
GREY = "#7a7a7a"
GRID = "#d9d9d9"

BLUE = "#0072B2"
SKY = "#56B4E9"
GREEN = "#009E73"
ORANGE = "#E69F00"
VERMILION = "#D55E00"
PURPLE = "#CC79A7"
"""Colour-blind-safe palette of Okabe and Ito (2008)."""

RC: dict[str, Any] = {
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "grid.color": GRID,
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.labelsize": 10,
    "legend.fontsize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.6,
    "hatch.linewidth": 0.7,
    "legend.frameon": False,
    "figure.dpi": 100,
    "savefig.dpi": 160,
    "savefig.bbox": "tight",
    "svg.hashsalt": "wheretolook",
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
}
"""Matplotlib parameters of figures on screen."""

PRINT = RC | {
    "font.size": 8,
    "axes.titlesize": 8.5,
    "axes.labelsize": 8,
    "legend.fontsize": 7,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "axes.linewidth": 0.6,
    "hatch.linewidth": 0.5,
    "lines.linewidth": 1.2,
    "lines.markersize": 4,
}
"""`RC` with font sizes and line widths for print."""


def new_figure(width_in: float, height_in: float) -> Figure:
    """Create an empty figure independent of pyplot. Draw into it within `with context(RC):`."""
    with context(RC):
        return Figure(figsize=(width_in, height_in), layout="constrained")


def frame(axes: Axes, color: str = INK, linewidth: float = 0.5) -> None:
    """Draw a frame around the axes of an image, without ticks and grid."""
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    axes.spines[:].set(visible=True, linewidth=linewidth, color=color)


_SCENES = {"aws_house": "furnished house", "nexuiz": "game level"}
"""Display names of external scenes and of the package that some of them come from."""


def scene_label(name: str) -> str:
    """Return the display name of a scene, such as "apartment 210" for "apartment-210"."""
    for known, label in _SCENES.items():
        if name == known or name.startswith(f"{known}_"):
            name = name.replace(known, label, 1)
    return name.replace("_", " ").replace("-", " ")


_METADATA: dict[str, tuple[str, dict[str, Any]]] = {
    "png": ("Description", {"Software": None}),
    "pdf": ("Subject", {"CreationDate": None, "Creator": None}),
    "svg": ("Description", {"Date": None}),
}
"""The field of a file's metadata that holds the note, and fields without dates and versions."""


def save_figure(figure: Figure, path: Path, note: str = "") -> None:
    """Write a figure to `path` (.png, .pdf or .svg) atomically; equal figures give equal bytes.

    `note`, such as the runs that the figure shows, is stored in the file's metadata. Raises ConfigError for another
    format.
    """
    kind = path.suffix[1:].lower()
    if kind not in KINDS:
        raise ConfigError("unsupported figure format", path=path, fix=f"Use {', '.join(KINDS)}.")
    field, metadata = _METADATA[kind]
    buffer = io.BytesIO()  # the PDF writer does not report the cause of a failed write
    with context(RC):
        figure.savefig(buffer, format=kind, metadata=metadata | ({field: note} if note else {}))
    write_bytes(path, buffer.getvalue())
