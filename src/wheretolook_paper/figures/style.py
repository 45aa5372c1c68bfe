"""Style of the paper's figures: widths and parameters for print, further colours, and names of scenes."""

from __future__ import annotations

from typing import Any

from wheretolook.figures.floor_plan import RC

Style = dict[str, Any]  # keyword arguments of Matplotlib functions

ONE_COLUMN_IN = 3.5
TWO_COLUMNS_IN = 7.2
"""Widths of one-column and two-column figures in print, inches; draw them with `PRINT`."""

GRID = RC["grid.color"]

SKY = "#56B4E9"
GREEN = "#009E73"
ORANGE = "#E69F00"
PURPLE = "#CC79A7"
"""Colours of Okabe and Ito (2008) beside those of `wheretolook.figures.floor_plan`."""

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


_SCENES = {"aws_house": "furnished house", "nexuiz": "game level"}
"""Display names of external scenes and of the package that some of them come from."""


def scene_label(name: str) -> str:
    """Return the display name of a scene, such as "apartment 210" for "apartment-210"."""
    for known, label in _SCENES.items():
        if name == known or name.startswith(f"{known}_"):
            name = name.replace(known, label, 1)
    return name.replace("_", " ").replace("-", " ")
