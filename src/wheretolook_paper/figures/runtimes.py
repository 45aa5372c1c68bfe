"""Times of the visibility check: compared with the paper's, and growth of time and memory with the problem size."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import cycle
from textwrap import shorten
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.style import context
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter, NullLocator

from wheretolook.figures.floor_plan import BLUE, INK, RC, VERMILION, new_figure
from wheretolook_paper.figures.style import GREEN, PURPLE, SKY, Style

COUNTS = "counts alone"
EVERYTHING = "occlusion, counts, best 100"
TWIN = "NumPy twin, counts alone, scaled"
"""Kinds of work in the runtime figure. The twin is the plain NumPy implementation."""


_PAPER = "from the paper"
_RELEASED = "authors' kernel, measured"
_OURS = "this project, measured"
_LOOK: dict[str, dict[str, Any]] = {
    _PAPER: {"facecolor": "white", "edgecolor": "#7a7a7a", "hatch": "///", "linewidth": 0.8},
    _RELEASED: {"facecolor": "#dedede", "edgecolor": "#7a7a7a", "hatch": "...", "linewidth": 0.8},
    _OURS: {"facecolor": SKY, "edgecolor": SKY, "linewidth": 0.8},
}
"""Styles of bars by the source of their number; hatches distinguish them in greyscale."""

_PANELS = {COUNTS: "counts alone: the work that the paper times"}
_PANELS[EVERYTHING] = "occlusion, counts and best 100 directions:\nmore than the paper times"


_STEP_TIMES = {"median": "median_s", "25 %": "q1_s", "75 %": "q3_s", "least": "min_s"}
"""Columns of the times of an inference step."""


@dataclass(frozen=True)
class _Bar:
    """One bar: label, median seconds, source of the number, text at its end, minimum and maximum seconds."""

    label: str
    seconds: float
    source: str
    text: str
    spread: tuple[float, float] | None = None


_FIXED_BARS = (
    _Bar("paper, CPU, 1 thread", 7387.0, _PAPER, "7,387 s"),
    _Bar("paper, GPU", 23.0, _PAPER, "23 s"),
    _Bar("released kernel, H200", 12.2, _RELEASED, "12.2 s"),
)
"""Fixed bars: the paper's runtime figure ("initial sampling"), and the authors' released CUDA kernel on an H200."""


def runtime_figure(sizes: pd.DataFrame) -> Figure:
    """Draw the paper's runtime figure with this project's times, at 648 locations x 24,919 landmarks.

    Bars are on a logarithmic axis in seconds, with whiskers from the shortest to the longest run: above the counts
    alone, which the paper times; below, if there are such rows, the complete work. `sizes` has a row for each machine,
    work and number of threads, with `what`, `threads`, `median_s`, `min_s`, `max_s`, `repeats`, `device` ("cpu" or
    Warp's CUDA device), `name` and `cores` of the machine. Rows of other work, and of the NumPy twin of
    a machine with a GPU, are ignored.
    """
    measured = _measured_bars(sizes)
    bars = {COUNTS: [*_FIXED_BARS, *measured[COUNTS]], EVERYTHING: measured[EVERYTHING]}
    shown = [what for what in _PANELS if bars[what]]
    every = [bar for what in shown for bar in bars[what]]
    # A logarithmic bar has no zero to start from: all start at the same power of ten, well below the shortest.
    start = 10.0 ** min(-3, np.floor(np.log10(min(bar.seconds for bar in every) / 1.5)))
    with context(RC):
        figure = new_figure(6.0, 1.1 + 0.32 * len(every) + 0.4 * len(shown))
        heights = [len(bars[what]) for what in shown]
        panels = figure.subplots(len(shown), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
        for axes, what in zip(panels, shown, strict=True):
            _draw_bars(axes, bars[what], start)
            axes.set_title(_PANELS[what], fontsize=10, loc="left")
        longest = max(bar.seconds for bar in every)
        panels[0].set_xlim(start, 20 * longest)  # room for the text of the longest bar
        powers = range(round(np.log10(start)), int(np.log10(2 * longest)) + 1)
        # Every second power has a label, or they would touch; 1 ms has one.
        labels = [_ticked(10.0**power) if power % 2 else "" for power in powers]
        panels[0].set_xticks([10.0**power for power in powers], labels)
        panels[0].xaxis.set_minor_locator(NullLocator())
        panels[-1].set_xlabel("time for 648 locations, 24,919 landmarks (log)")
        sources = dict.fromkeys(bar.source for bar in every)
        handles = [Patch(label=source, **_LOOK[source]) for source in sources]
        figure.legend(handles=handles, loc="outside upper center", ncols=3, columnspacing=1.4, handlelength=1.8)
        return figure


def runtime_table(sizes: pd.DataFrame) -> pd.DataFrame:
    """Return the times that `runtime_figure` draws: a row for each machine, work and number of threads."""
    rows = sizes[sizes["what"].isin((TWIN, COUNTS, EVERYTHING))]
    columns = {"machine": rows["name"].map(machine_label), "work": rows["what"], "threads": rows["threads"]}
    columns |= {"median (s)": rows["median_s"], "least (s)": rows["min_s"], "most (s)": rows["max_s"]}
    columns |= {"projections (10⁹/s)": rows["projections_per_s"] / 1e9}
    return pd.DataFrame(columns).sort_values(["work", "median (s)"], ignore_index=True)


def step_table(sizes: pd.DataFrame) -> pd.DataFrame:
    """Return median, quartiles and minimum (ms) of one inference step of each scorer, the paper's first.

    `sizes` is that of `runtime_figure`; the steps are its rows of one location, which also have `q1_s` and `q3_s`.
    """
    rows: list[dict[str, Any]] = [{"machine": "the paper's", "scorer": "the paper's network", "median (ms)": 20.0}]
    for row in sizes[sizes["locations"] == 1].sort_values(["name", "what"]).to_dict("records"):
        machine = machine_label(row["name"]) + ("" if _is_gpu(row) else f", {_threads(row)}")
        size = {"views": row["directions"], "landmarks": row["landmarks"]}
        times = {f"{name} (ms)": 1e3 * row[key] for name, key in _STEP_TIMES.items()}
        rows.append({"machine": machine, "scorer": row["what"].rpartition(", ")[0], **size, **times})
    columns = ["machine", "scorer", "views", "landmarks", *(f"{name} (ms)" for name in _STEP_TIMES)]
    return pd.DataFrame(rows, columns=columns)


def _draw_bars(axes: Axes, bars: list[_Bar], start: float) -> None:
    plate: Style = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}
    for y, bar in enumerate(bars):
        axes.barh(y, bar.seconds - start, 0.68, left=start, **_LOOK[bar.source])
        end = bar.seconds
        if bar.spread is not None:
            low, high = bar.spread
            ends = [[max(bar.seconds - low, 0)], [max(high - bar.seconds, 0)]]
            axes.errorbar(bar.seconds, y, xerr=ends, fmt="none", ecolor=INK, elinewidth=1, capsize=2.5)
            end = max(end, high)
        axes.annotate(bar.text, (end, y), (5, 0), textcoords="offset points", va="center", fontsize=9.5, bbox=plate)
    axes.set_xscale("log")
    axes.set_yticks(range(len(bars)), [_wrapped(bar.label) for bar in bars], fontsize=9.5)
    axes.set_ylim(len(bars) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", length=0)


def _wrapped(label: str) -> str:
    return label if len(label) <= 27 else ",\n".join(label.rsplit(", ", 1))


def _measured_bars(sizes: pd.DataFrame) -> dict[str, list[_Bar]]:
    """Return the bars of each panel: the NumPy twin first, CPUs before GPUs, few threads before many."""
    bars: dict[str, list[_Bar]] = {COUNTS: [], EVERYTHING: []}
    rows = [row for row in sizes.to_dict("records") if row["what"] in (bars if _is_gpu(row) else (TWIN, *bars))]
    for row in sorted(rows, key=lambda row: (row["what"] != TWIN, _is_gpu(row), row["name"], row["threads"])):
        median = float(row["median_s"])
        repeats = int(row["repeats"])
        spread = (float(row["min_s"]), float(row["max_s"])) if repeats > 1 else None
        label = machine_label(row["name"]) + ("" if _is_gpu(row) else f", {_threads(row)}")
        what = str(row["what"])
        if what == TWIN:
            label = "NumPy, 1 thread, scaled up"
            what = COUNTS
        bars[what].append(_Bar(label, median, _OURS, duration(median), spread))
    return bars


def _is_gpu(row: dict[Any, Any]) -> bool:
    return str(row["device"]) != "cpu"


def _threads(row: dict[Any, Any]) -> str:
    if row["threads"] == 1:
        return "1 thread"
    return f"all {row['cores']} cores" if row["threads"] == row["cores"] else f"{row['threads']} threads"


def machine_label(name: str) -> str:
    """Shorten a processor's name; "CPU" if only the architecture is known."""
    short = re.sub(r"\((R|TM|C)\)|\b\d+-Cores?\b|\b(Processor|CPU)\b|@.*$", " ", str(name), flags=re.IGNORECASE)
    short = shorten(short, 28, placeholder="…")
    return short if short not in ("", "x86_64", "AMD64", "aarch64", "arm64", "i386", "arm") else "CPU"


def duration(seconds: float) -> str:
    """Format a time with three digits: "3.58 ms", "149 s"."""
    value, unit = (seconds, "s") if float(f"{seconds:.3g}") >= 1 else (1e3 * seconds, "ms")
    digits = max(0, 2 - int(np.floor(np.log10(float(f"{value:.3g}")))))
    return f"{float(f'{value:.3g}'):,.{digits}f} {unit}"


def _ticked(seconds: float) -> str:
    return f"{seconds:,.0f} s" if seconds >= 0.9 else f"{1e3 * seconds:g} ms"


_GROWING = ("landmarks", "locations", "directions")
_MACHINES = ((BLUE, "o"), (VERMILION, "s"), (GREEN, "D"), (PURPLE, "^"))
_WORK: dict[str, tuple[Any, bool]] = {"with occlusion": ("-", True), COUNTS: ((0, (4, 1.5)), False)}
"""Dashes of each kind of work, and whether its markers are filled."""


def scaling_figure(growth: pd.DataFrame) -> Figure:
    """Draw how time (above) and memory (below) grow with the number of landmarks, locations or directions.

    All axes are logarithmic; a dotted line shows proportional growth. `growth` has a row for each run, with `axis`
    (which of the three grows), `landmarks`, `locations`, `directions`, `what` ("with occlusion", "counts alone"),
    `median_s`, `min_s`, `max_s`, `peak_bytes` (0, not drawn, where it was too little to measure), `device` and `name`
    of the machine.
    """
    machines = list(dict.fromkeys(zip(growth["device"], growth["name"], strict=True)))
    shown = [axis for axis in _GROWING if (growth["axis"] == axis).any()]
    with context(RC):
        figure = new_figure(2.2 * len(shown) + 0.7, 5.2)
        scales: Style = {"xscale": "log", "yscale": "log"}
        panels = figure.subplots(2, len(shown), sharex="col", sharey="row", squeeze=False, subplot_kw=scales)
        for column, axis in enumerate(shown):
            part = growth[growth["axis"] == axis]
            for (device, name), (color, marker) in zip(machines, cycle(_MACHINES), strict=False):
                of_machine = part[(part["device"] == device) & (part["name"] == name)]
                _draw_growth(panels[:, column], of_machine, axis, machine_label(name), color, marker)
            fixed = (f"{_numbers(part[other])} {other}" for other in _GROWING if other != axis)
            panels[0, column].set_title("\n".join(fixed), fontsize=9)
            panels[1, column].set_xlabel(axis)
        panels[0, 0].set_ylabel("time (s)")
        panels[1, 0].set_ylabel("peak memory (MB)")
        for axes in panels.flat:
            _format_log_axes(axes)
        for axes in panels.flat:  # after all limits are set
            _draw_proportional(axes)
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3, columnspacing=1.4, handlelength=2.6)
        return figure


def _draw_growth(panels: Any, rows: pd.DataFrame, axis: str, machine: str, color: str, marker: str) -> None:
    """Draw time and memory of a machine in a column of two panels."""
    for what, (dashes, filled) in _WORK.items():
        of_work = rows[rows["what"] == what].sort_values(axis)
        style: Style = {"color": color, "linestyle": dashes, "marker": marker, "markersize": 4.5}
        style["markerfacecolor"] = color if filled else "white"
        seconds = of_work["median_s"].to_numpy(dtype=float)
        spread = np.clip([seconds - of_work["min_s"], of_work["max_s"] - seconds], 0, None)
        panels[0].plot(of_work[axis], seconds, label=f"{machine}, {what}", **style)
        panels[0].errorbar(
            of_work[axis], seconds, spread, fmt="none", ecolor=color, elinewidth=1, capsize=2, zorder=1.9
        )
        measurable = of_work[of_work["peak_bytes"] > 0]
        panels[1].plot(measurable[axis], measurable["peak_bytes"] / 1e6, **style)


def _format_log_axes(axes: Axes) -> None:
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:,.10g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_minor_formatter(NullFormatter())
    if np.ptp(np.log10(axes.get_ylim())) < 2:  # otherwise the axis would have a single number
        axes.yaxis.set_major_locator(LogLocator(10, subs=(1, 2, 5)))


def _numbers(values: pd.Series) -> str:
    return " / ".join(f"{value:,.0f}" for value in sorted(values.unique()))


def _draw_proportional(axes: Axes) -> None:
    """Draw a line of slope 1 through the middle of the panel without changing its limits."""
    (left, right) = axes.get_xlim()
    limits = axes.get_ylim()
    slope = np.sqrt(limits[0] * limits[1] / (left * right))
    look: Style = {"color": "#9a9a9a", "linewidth": 0.8, "linestyle": ":", "zorder": 0.9, "label": "proportional"}
    axes.plot([left, right], [slope * left, slope * right], scalex=False, scaley=False, **look)
    axes.set(xlim=(left, right), ylim=limits)
