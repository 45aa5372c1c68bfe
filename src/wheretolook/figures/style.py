"""One look for every figure: colours that the colour-blind can tell apart, and marks that survive in greyscale."""

from __future__ import annotations

import html
import io
import re
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.figures.config import KINDS
from wheretolook.utils.errors import ConfigError
from wheretolook.utils.files import write_bytes

ONE_COLUMN_IN = 3.5
TWO_COLUMNS_IN = 7.2
"""Widths of figures for one and for two columns of a paper, inches. Their letters are as large as they will be in
print: `PRINT`. Figures for the screen are wider, with the letters of `RC`."""

INK = "#333333"
GREY = "#7a7a7a"
GRID = "#d9d9d9"

BLUE = "#0072B2"
SKY = "#56B4E9"
GREEN = "#009E73"
ORANGE = "#E69F00"
VERMILION = "#D55E00"
PURPLE = "#CC79A7"
"""The colours of Okabe and Ito (2008), which colour-blind people can tell apart."""

_INKED = ("axes.edgecolor", "axes.labelcolor", "text.color", "xtick.color", "ytick.color")
RC: dict[str, Any] = {**dict.fromkeys(_INKED, INK), "grid.color": GRID}
RC |= {"font.size": 10, "axes.titlesize": 11, "axes.labelsize": 10, "legend.fontsize": 9}
RC |= {"axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "axes.axisbelow": True}
RC |= {"grid.linewidth": 0.6, "lines.linewidth": 1.6, "hatch.linewidth": 0.7, "legend.frameon": False}
RC |= {"figure.dpi": 100, "savefig.dpi": 160, "savefig.bbox": "tight"}
RC |= {"svg.hashsalt": "wheretolook", "svg.fonttype": "none", "pdf.fonttype": 42}
"""Matplotlib's parameters for figures on the screen."""

PRINT = {**RC, "font.size": 8, "axes.titlesize": 8.5, "axes.labelsize": 8, "legend.fontsize": 7}
PRINT |= {"xtick.labelsize": 7, "ytick.labelsize": 7, "axes.linewidth": 0.6, "hatch.linewidth": 0.5}
PRINT |= {"lines.linewidth": 1.2, "lines.markersize": 4}
"""`RC` with the letters and lines of a printed column."""


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure in this style, independent of pyplot and its global state. Draw in `with context(RC):`."""
    with context(RC):
        return Figure(figsize=(width_in, height_in), layout="constrained")


_SCENES = {"aws_house": "furnished house", "nexuiz": "game level"}
"""Names that say nothing to people: of the scenes made by others, and of the package that some are from."""


def scene_label(name: str) -> str:
    """The name of a scene for people: "apartment 210" of "apartment-210", "game level aggressor" of its file's name."""
    if name in _SCENES:
        return _SCENES[name]
    package, _, rest = name.partition("_")
    if package in _SCENES and rest:
        name = f"{_SCENES[package]} {rest}"
    return name.replace("_", " ").replace("-", " ")


_NOTE = {"png": "Description", "pdf": "Subject", "svg": "Description"}


def save_figure(figure: Figure, path: Path, note: str = "") -> None:
    """Write a figure, atomically, the same figure as the same bytes; its folder is made when needed.

    The path's suffix says what kind of file: .png, .pdf or .svg, the latter two as vectors. The note, such as the runs
    that the figure was made from, is kept in the file's metadata. Raises ConfigError for other kinds of files.
    """
    kind = path.suffix[1:].lower()
    if kind not in KINDS:
        raise ConfigError("figures are not written as such files", path=path, fix=f"Use {', '.join(KINDS)}.")
    # without dates and versions
    metadata: dict[str, Any] = {"pdf": {"CreationDate": None, "Creator": None}, "svg": {"Date": None}}.get(kind, {})
    if note:
        metadata[_NOTE[kind]] = note
    drawn = io.BytesIO()  # not into the file: of a full disk, PDFs tell no cause
    with context(RC):
        figure.savefig(drawn, format=kind, metadata={**metadata, **({"Software": None} if kind == "png" else {})})
    write_bytes(path, drawn.getvalue())


def note_of(path: Path) -> str:
    """What `save_figure` kept in a figure's metadata; empty if nothing. Raises ConfigError for other kinds of files."""
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
