"""Figures and film of planned paths: shares that localize, views and scores along them, and nearest photographs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context
from numpy.typing import NDArray

from wheretolook.dataset.config import ALL
from wheretolook.dataset.layout import Dataset
from wheretolook.figures.floor_plan import BLUE, GREY, INK, RC, VERMILION, frame, label_plan, new_figure, plan_extent
from wheretolook.geometry.poses import Float, poses_looking_along
from wheretolook.geometry.views import Views
from wheretolook.mapping.map_frame import IDENTITY
from wheretolook.planning.view_sequence import lengths_along
from wheretolook.utils.errors import MissingRunError
from wheretolook.utils.texts import counted, markdown_table, score_text
from wheretolook_paper.figures.animation import Pixels, pixels_of
from wheretolook_paper.figures.style import Style, scene_label
from wheretolook_paper.styles import method_style

FILLED = {"greedy": "full", "with stops": "left"}
"""Fill of markers by the suffix of a method's name."""

TITLES = {"planned": "each method plans places and views", "given": "each method turns the camera along given paths"}
NAMES = {"forward": "looking ahead", "greedy": "by ActLoc's greedy rule"}
"""Labels that differ from tables: of methods and of suffixes."""


def paths_figure(summary: pd.DataFrame) -> Figure:
    """Draw the share of views along paths that localize, from the table of `summarize_paths`.

    A panel for each task has a row for each scene, all scenes first, and a marker for each method with its 95 %
    interval: open for views chosen by ActLoc's rule, half filled for jointly localized views.
    """
    with context(RC):
        tasks = list(dict.fromkeys(summary["task"]))
        scenes = sorted(dict.fromkeys(summary["scene"]), key=lambda name: name != ALL)
        figure = new_figure(2.0 + 4.0 * len(tasks), 1.3 + 0.55 * len(scenes))
        panels = figure.subplots(1, len(tasks), sharex=True, sharey=True, squeeze=False)[0]
        for axes, task in zip(panels, tasks, strict=True):
            rows = summary[summary["task"] == task]
            methods = list(dict.fromkeys(rows["method"]))
            for number, method in enumerate(methods):
                of_method = rows[rows["method"] == method].set_index("scene").reindex(scenes)
                at = np.arange(len(scenes)) + 0.7 * ((number + 0.5) / len(methods) - 0.5)
                name, _, rule = method.partition(" ")
                style = method_style(name)
                value, low, high = (100 * of_method[f"localized{end}"].to_numpy() for end in ("", "_low", "_high"))
                axes.hlines(at, low, high, color=style.color, linewidth=1.2)
                fill = FILLED.get(rule, "bottom" if rule else "full")
                face = "white" if rule == "greedy" else style.color
                look: Style = {"markersize": 6, "fillstyle": fill, "markerfacecolor": face}
                look["markerfacecoloralt"] = "white"
                label = NAMES.get(name, style.label)
                label += f", {NAMES.get(rule, rule)}" if rule else ""
                axes.plot(value, at, style.marker, color=style.color, label=label, **look)
            axes.set_title(TITLES.get(task, task))
            axes.set_xlabel("views along the paths that localize (%)")
            axes.axhline(0.5, color=INK, linewidth=0.8)
            axes.grid(axis="y", visible=False)
            axes.tick_params(axis="y", length=0)
        names = ["all scenes" if name == ALL else scene_label(name) for name in scenes]
        panels[0].set_yticks(np.arange(len(scenes)), names)
        panels[0].set(ylim=(len(scenes) - 0.5, -0.5), xlim=(None, 101))
        named: dict[str, Any] = {}
        for axes in panels:
            handles, labels = axes.get_legend_handles_labels()
            named |= dict(zip(labels, handles, strict=True))
        figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=3, frameon=False)
        return figure


PATH = "#CC3311"
LANDMARKS = "#EE9900"
FRAME_MS = 125

_STOP: Style = {"marker": "o", "color": "white", "markeredgecolor": PATH, "markeredgewidth": 1.6, "linestyle": "none"}
_ARROW: Style = {"arrowstyle": "-|>", "color": INK, "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 8}
_NUMBER: Style = {"boxstyle": "circle,pad=0.15", "facecolor": PATH, "edgecolor": "white"}


def film_frames(views: Views, landmarks: Float) -> Iterator[Pixels]:
    """Draw one frame (H, W, 3) per view: its image with visible landmarks, the map, and the score along the path.

    `landmarks` (N, 3) are those of the map, in the frame of the views; there is at least one view.
    """
    with context(RC):
        figure = new_figure(9.6, 4.4)
        grid = figure.add_gridspec(2, 2, width_ratios=(1.5, 1.0), height_ratios=(1.7, 1.0))
        panels = [figure.add_subplot(place) for place in (grid[:, 0], grid[0, 1], grid[1, 1])]
        for number in range(len(views)):
            for panel in panels:  # axes stay: making ticks again takes most of the time
                for artist in [*panel.images, *panel.collections, *panel.lines, *panel.patches, *panel.texts]:
                    artist.remove()
            _draw_view(panels[0], views, number)
            draw_path(panels[1], views, landmarks, number)
            _draw_scores(panels[2], views, number)
            yield pixels_of(figure)
            figure.set_layout_engine("none")  # the first frame's serves all


def still_figure(views: Views, landmarks: Float, title: str = "") -> Figure:
    """Draw a path from above, its score, and some evenly spread views of it.

    `landmarks` (N, 3) are those of the map, in the frame of the views; there is at least one view.
    """
    own = np.flatnonzero(views.rank == 1)
    shown = own[np.unique(np.linspace(0, len(own) - 1, 5).round().astype(int))].tolist()
    with context(RC):
        figure = new_figure(2.5 * max(4, len(shown)), 5.8)
        grid = figure.add_gridspec(2, 1, height_ratios=(1.6, 1.0))
        above = grid[0].subgridspec(1, 2, width_ratios=(1.1, 1.0))
        axes = figure.add_subplot(above[0])
        draw_path(axes, views, landmarks, None, shown)
        axes.set_title(title)
        _draw_scores(figure.add_subplot(above[1]), views, None, shown)
        cells = grid[1].subgridspec(1, len(shown))
        for column, number in enumerate(shown):
            _draw_view(figure.add_subplot(cells[column]), views, number, f"{column + 1}: ")
        return figure


def methods_figure(paths: Mapping[str, Views], landmarks: Float) -> Figure:
    """Draw the paths of several methods side by side from above, with viewing directions (paper, Sec. 4.3).

    `paths` maps the name of each method to the views along its path; `landmarks` (N, 3).
    """
    with context(RC):
        figure = new_figure(3.9 * len(paths), 4.2)
        for axes, (name, views) in zip(figure.subplots(1, len(paths), squeeze=False)[0], paths.items(), strict=True):
            draw_path(axes, views, landmarks)
            n_visible = np.mean([len(pixels) for pixels in views.pixels])
            axes.set_title(f"{method_style(name).label}\n{n_visible:,.0f} landmarks in view on average", fontsize=10)
        return figure


def _draw_view(axes: Axes, views: Views, number: int, prefix: str = "") -> None:
    assert views.camera is not None
    width, height = views.camera.width, views.camera.height
    pixels, score = views.pixels[number], views.score[number]
    if views.images is not None:
        axes.imshow(views.images[number], extent=(0, width, height, 0))
    axes.scatter(pixels[:, 0], pixels[:, 1], s=3, color=LANDMARKS, linewidths=0)
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal", anchor="N")
    frame(axes, linewidth=0.8)
    n_views = _views_there(views)[number]
    stop = f"view {views.rank[number]} of {n_views}: " if n_views > 1 else ""
    text = "" if np.isnan(score) else f", score {score_text(float(score))}"
    axes.set_title(f"{prefix}{stop}{counted(len(pixels), 'landmark')}{text}", fontsize=9)


def _views_there(views: Views) -> NDArray[np.int64]:
    """Return the number (V,) of views at each view's position."""
    return np.bincount(views.waypoint)[views.waypoint]


def draw_path(axes: Axes, views: Views, landmarks: Float, number: int | None = None, shown: Sequence[int] = ()) -> None:
    """Draw landmarks (N, 2 or 3) and path from above, arrows along it or at view `number`, numbers at views `shown`."""
    of = views.frame or IDENTITY
    turn = of.world_from_map.rotation.T
    positions = views.positions @ turn
    along_axes = views.axes @ turn
    landmarks = landmarks @ turn if of.is_turned else landmarks
    xy = positions[:, :2]
    low, high = plan_extent(landmarks, positions)
    axes.scatter(landmarks[:, 0], landmarks[:, 1], s=0.5, color="#9a9a9a", linewidths=0, rasterized=True)
    axes.plot(*xy.T, color=PATH, linewidth=2.2, zorder=3)
    stops = xy[(views.rank == 1) & (_views_there(views) > 1)]
    axes.plot(*stops.T, markersize=7, zorder=3.5, **_STOP)
    along = lengths_along(positions)
    arrows = np.unique(np.searchsorted(along, np.linspace(0, along[-1], 12) - 1e-9)).tolist()
    length = margin = 0.07 * float(np.max(high - low))
    if number is not None:
        arrows = [number]
        length *= 2
    for at in arrows:
        axes.annotate("", xy[at] + along_axes[at, :2] * length, xy[at], arrowprops=_ARROW, zorder=4)
    for label, at in enumerate(shown, 1):
        axes.annotate(str(label), xy[at], fontsize=9, color="white", ha="center", va="center", bbox=_NUMBER, zorder=5)
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin), aspect="equal")
    label_plan(axes, of, low, float((high - low).max()))


def _draw_scores(axes: Axes, views: Views, number: int | None, shown: Sequence[int] = ()) -> None:
    """Draw the score along the path, with a mark at view `number` and numbers at views `shown`."""
    along = lengths_along(views.positions)
    scores = views.score
    joint = np.where(_views_there(views) > 1, views.set_score, np.nan)
    own = views.rank == 1
    axes.plot(along[own], scores[own], color=PATH, linewidth=1.4)
    stops = own & np.isfinite(joint)
    if stops.any():
        axes.vlines(along[stops], scores[stops], joint[stops], color=PATH, linewidth=0.8, linestyle=":")
        axes.plot(along[stops], joint[stops], label="all views of a stop", markersize=6, **_STOP)
        axes.legend(loc="best", fontsize=8)
    if number is not None:
        axes.plot(along[number], scores[number], "o", color=INK, markersize=6)
    for label, at in enumerate(shown, 1):
        side = "left" if at == 0 else "right" if at == len(views) - 1 else "center"
        axes.annotate(str(label), (along[at], scores[at]), (0, 6), textcoords="offset points", ha=side)
    finite = np.concatenate([scores, joint])
    finite = finite[np.isfinite(finite)]
    lowest, highest = (finite.min(), finite.max()) if len(finite) else (0.0, 1.0)
    margin = max(0.25 * (highest - lowest), 0.02 * max(1.0, abs(highest)))  # a constant score is in the middle
    axes.set(xlim=(0, max(along[-1], 1e-6)), ylim=(lowest - margin, highest + margin))
    axes.set(xlabel=f"along the path ({(views.frame or IDENTITY).unit})", ylabel="score")


PATHS_CSV = "plan_photographs.csv"
LANDMARKS_CSV = "plan_photographs_landmarks.csv"
"""Files in a release's `results/`: the table of `wheretolook_paper.studies.plan_photographs`, and some landmarks of the
same maps from above."""

COMMAND = "python -m wheretolook_paper.studies.plan_photographs --map MODEL --work FOLDER --out TABLE"
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
        # three views of a path are shown with their photographs
        shown = np.unique(np.linspace(0, len(rows) - 1, 3).round().astype(int)).tolist()
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
