"""Paths planned on maps of photographs, and the photographs nearest to their views (paper, Fig. 5)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context
from numpy.typing import NDArray

from wheretolook.dataset.layout import Dataset
from wheretolook.figures.floor_plan import BLUE, GREY, RC, VERMILION, frame, new_figure
from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.geometry.views import Views
from wheretolook.planning.view_sequence import lengths_along
from wheretolook.utils.errors import MissingRunError
from wheretolook.utils.texts import markdown_table
from wheretolook_paper.figures.path_film import PATH, draw_path
from wheretolook_paper.figures.style import scene_label
from wheretolook_paper.styles import method_style

PATHS_CSV = "plan_photographs.csv"
LANDMARKS_CSV = "plan_photographs_landmarks.csv"
"""Files in a release's `results/`: the table of `wheretolook_paper.studies.plan_photographs`, and some landmarks of the
same maps from above."""

COMMAND = "python -m wheretolook_paper.studies.plan_photographs --map MODEL --work FOLDER --out TABLE"
N_SHOWN = 3  # views of a path whose photographs are shown
POSITION = ["x", "y", "z"]
AXIS = ["axis_x", "axis_y", "axis_z"]
Pictures = Mapping[str, NDArray[np.uint8]]
"""Photographs (H, W, 3) by name."""


def read_photograph_paths(release: Dataset) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Read the table and the landmarks of a release. Raises MissingRunError without them."""
    results = release.root / "results"
    if not (results / PATHS_CSV).is_file():
        raise MissingRunError(COMMAND)
    return pd.read_csv(results / PATHS_CSV), pd.read_csv(results / LANDMARKS_CSV)


def photograph_paths_figure(table: pd.DataFrame, landmarks: pd.DataFrame, pictures: Pictures | None = None) -> Figure:
    """Draw, for each scene, the paths of several methods from above, the landmarks along them, and photographs.

    Args:
        table: a row for each view, as `wheretolook_paper.studies.plan_photographs` writes it.
        landmarks: scene, x, y.
        pictures: photographs by name; of those that are missing, names are drawn instead.
    """
    scenes = list(dict.fromkeys(table["scene"]))
    n_methods = table.groupby("scene")["method"].nunique().max()
    with context(RC):
        figure = new_figure(4.3 * n_methods, (7.2 if pictures else 5.8) * len(scenes))
        for part, scene in zip(figure.subfigures(len(scenes), squeeze=False)[:, 0], scenes, strict=True):
            rows = table[table["scene"] == scene]
            points = landmarks.loc[landmarks["scene"] == scene, ["x", "y"]].to_numpy()
            _draw_scene(part, rows, points, pictures or {})
        return figure


def _draw_scene(figure: Any, table: pd.DataFrame, landmarks: Float, pictures: Pictures) -> None:
    unit = table["unit"].iloc[0]
    methods = dict(iter(table.groupby("method", sort=False)))
    figure.suptitle(f"{scene_label(table['scene'].iloc[0])}, {table['photographs'].iloc[0]} photographs")
    grid = figure.add_gridspec(3, len(methods), height_ratios=(2.0, 0.9, 1.5 if pictures else 0.5))
    most = 1.1 * max(1, table["visible"].max())
    for column, (method, rows) in enumerate(methods.items()):
        axes = figure.add_subplot(grid[0, column])
        shown = np.unique(np.linspace(0, len(rows) - 1, N_SHOWN).round().astype(int)).tolist()
        at = rows[POSITION].to_numpy()
        one = np.ones(len(rows), dtype=np.int64)
        views = Views(poses_looking_along(at, rows[AXIS].to_numpy()), waypoint=np.arange(len(rows)), rank=one)
        draw_path(axes, views, landmarks, shown=shown)
        axes.set(xlabel=f"x ({unit})", ylabel=f"y ({unit})")
        axes.set_title(f"{method_style(str(method)).label}\n{_summary(rows)}", fontsize=10)
        curve = figure.add_subplot(grid[1, column])
        along = lengths_along(at)
        curve.plot(along, rows["visible"], color=PATH)
        for number, row in enumerate(shown, 1):
            curve.annotate(str(number), (along[row], rows["visible"].iloc[row]), (0, 4), textcoords="offset points")
        curve.set(ylim=(0, most), xlabel=f"along the path ({unit})")
        curve.set_ylabel("landmarks visible" if column == 0 else "")
        cells = grid[2, column].subgridspec(1, len(shown))
        for number, row in enumerate(shown):
            _draw_photograph(figure.add_subplot(cells[number]), number + 1, rows.iloc[row], pictures)


def _draw_photograph(axes: Axes, number: int, view: pd.Series, pictures: Pictures) -> None:
    """Draw the photograph nearest to a view, framed by whether it localizes; or write its name."""
    result, color = "not held out", GREY
    if pd.notna(view["localized"]):
        result, color = ("localized", BLUE) if view["localized"] else ("not localized", VERMILION)
    unit = "m" if view["unit"] == "m" else "depths"
    name = view["image"].partition(".")[0]
    text = f"{name}\n{view['distance']:.2f} {unit}, {view['angle_deg']:.0f}°\n"
    text += result if view["shown"] else "not of this view"
    rgb = pictures.get(view["image"])
    if rgb is not None:
        axes.imshow(rgb)
        axes.set_title(f"{number}: {text}", fontsize=7.5)
        axes.set_anchor("N")
    else:
        axes.text(0.5, 0.5, f"{number}: {text}", ha="center", va="center", fontsize=7.5, transform=axes.transAxes)
    frame(axes, color if view["shown"] else GREY, linewidth=2.0)


def _summary(rows: pd.DataFrame) -> str:
    """Describe the landmarks along a path, and its photographs."""
    of_views = rows[rows["shown"]]
    localized = int((of_views["localized"] == 1).sum())
    text = f"{rows['visible'].mean():,.0f} landmarks visible on average\n"
    if not len(of_views):
        return text + f"no photograph shows any of its {len(rows)} views"
    text += f"photographs show {len(of_views)} of {len(rows)} views, "
    return text + (f"{localized} localize" if localized else "none localizes")


def photograph_paths_markdown(table: pd.DataFrame) -> str:
    """Format means along the paths: landmarks visible, probability, views that photographs show and that localize."""
    lines = []
    for names, rows in table.groupby(["scene", "method"], sort=False):
        scene, method = map(str, names)
        of_views = rows[rows["shown"]]
        lines.append([
            scene_label(scene), method_style(method).label, f"{rows['visible'].mean():,.0f}",
            f"{rows['visible'].min():,}", f"{rows['probability'].mean():.2f}", f"{len(of_views)} of {len(rows)}",
            f"{int((of_views['localized'] == 1).sum())} of {len(of_views)}" if len(of_views) else "–",
        ])  # fmt: skip
    header = ["map", "path by", "landmarks visible, mean", "least", "mean probability (set)"]
    return markdown_table([*header, "views that a photograph shows", "these localize"], lines)
