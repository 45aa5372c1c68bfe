"""Draw the results of a check in one figure."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.evaluation.statistics import reliability
from wheretolook.figures.floor_plan import BLUE, INK, RC, VERMILION, new_figure
from wheretolook.geometry.poses import Float

if TYPE_CHECKING:
    from wheretolook.holdout.report import CheckReport

_GOOD = BLUE
_BAD = VERMILION
_UNTESTED = "#999999"
_MAX_LANDMARKS = 20_000  # drawn
_CURVE_BINS = 10  # fewer than of the calibration error, as photographs are few


def check_figure(report: CheckReport) -> Figure:
    """Draw the map from above with all photographs, and predictions against results for views and for blocks.

    The colour of a photograph is its result in the block of the partition; numbers are those of parts that relocalize
    badly.
    """
    with context(RC):
        figure = new_figure(12.5, 6.6)
        grid = figure.add_gridspec(2, 3, width_ratios=(2.1, 1, 1))
        _draw_map(figure.add_subplot(grid[:, 0]), report)
        _draw_calibration(figure.add_subplot(grid[0, 1]), report)
        _draw_inliers(figure.add_subplot(grid[0, 2]), report)
        _draw_blocks(figure.add_subplot(grid[1, 1:]), report)
        figure.suptitle(textwrap.fill(f"{report.source.name}: {report.sentence()}", 120), fontsize=11)
        return figure


def _draw_map(axes: Axes, report: CheckReport) -> None:
    source = report.source
    points = (source.arrays.points - source.from_model.translation) / source.from_model.scale
    centers = source.own_centers @ source.from_model.rotation.T
    looks = source.poses[:, 2, :3]
    ends = np.concatenate([np.percentile(points[:, :2], (2, 98), axis=0), centers[:, :2]])
    low = ends.min(0)
    high = ends.max(0)
    margin = 0.1 * (high - low).max()  # the numbers of weak parts are up to 0.08 out
    step = max(1, len(points) // _MAX_LANDMARKS)
    axes.scatter(points[::step, 0], points[::step, 1], s=1, color="#c4c4c4", linewidths=0, rasterized=True, zorder=1)
    length = 0.035 * float((high - low).max())
    localized = report.photographs["localized"].to_numpy(dtype=float, na_value=np.nan)
    kinds = [(np.isnan(localized), _UNTESTED, "not tested"), (localized == 1, _GOOD, "localized")]
    kinds.append((localized == 0, _BAD, "not localized"))
    for mask, color, label in kinds:
        if not mask.any():
            continue
        at = centers[mask, :2]
        along = looks[mask, :2] * length
        axes.quiver(
            *at.T, *along.T, color=color, angles="xy", scale_units="xy", scale=1, width=0.0025, headwidth=3, zorder=3
        )
        axes.scatter(at[:, 0], at[:, 1], s=14, color=color, label=f"{label} ({mask.sum()})", zorder=4, linewidths=0)
    for part in report.parts:
        middle = np.median(centers[part.rows, :2], axis=0)
        out = np.median(looks[part.rows, :2], axis=0) * -2.2 * length
        style: dict[str, Any] = {"arrowstyle": "-", "color": INK, "linewidth": 0.8}
        box: dict[str, Any] = {"boxstyle": "circle,pad=0.2", "facecolor": "white", "edgecolor": _BAD}
        axes.annotate(
            str(part.number), tuple(middle), tuple(middle + out), fontsize=9, ha="center", va="center", zorder=5,
            arrowprops=style, bbox=box,
        )  # fmt: skip
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin), aspect="equal")
    if source.is_turned:
        _draw_own_axes(axes, source.from_model.rotation, low, float(f"{(high - low).max() / 4:.0e}"), source.unit)
    else:
        axes.set(xlabel=f"x ({source.unit})", ylabel=f"y ({source.unit})")
    axes.set_title("from above; photographs held out with their neighbours", pad=24)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, handletextpad=0.1, borderaxespad=0.2)


def _draw_own_axes(axes: Axes, rotation: Float, corner: Float, length: float, unit: str) -> None:
    """Draw the axes of a map's own frame, which a rotation (3, 3) turned upright, from a corner (2,) of the drawing."""
    directions = length * rotation[:2].T
    start = corner - directions.min(axis=0)
    for name, direction in zip("xyz", directions, strict=True):
        axes.annotate(name, tuple(start), tuple(start + direction), arrowprops={"arrowstyle": "<-", "color": INK})
    text = f"the map's own axes, {length:g} {unit} long; it is turned upright here only"
    axes.set(xticks=[], yticks=[], xlabel=text)


def _draw_calibration(axes: Axes, report: CheckReport) -> None:
    numbers = report.numbers
    views = report.views
    if numbers["ece"] is None:
        good = views["good"].to_numpy(dtype=bool)
        for mask, color, label in ((good, _GOOD, "localized"), (~good, _BAD, "not localized")):
            axes.hist(views["score"][mask], bins=20, color=color, alpha=0.6, label=label)
        axes.set(xlabel=f"score of {report.method}", ylabel="views", title="scores")
        axes.legend()
        return
    curve = reliability(views["score"].to_numpy(), views["good"].to_numpy(dtype=bool), _CURVE_BINS)
    known = curve[curve["n"] > 0]
    axes.plot([0, 1], [0, 1], color=INK, linewidth=1, linestyle="--")
    axes.plot(known["mean_predicted"], known["share_good"], color=_GOOD, zorder=3)
    sizes = 12 + 140 * known["n"] / known["n"].max()
    axes.scatter(known["mean_predicted"], known["share_good"], s=sizes, color=_GOOD, zorder=3, clip_on=False)
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="predicted probability", ylabel="share that localizes")
    axes.set_title(f"calibration error {numbers['ece']['value']:.2f}")


def _draw_inliers(axes: Axes, report: CheckReport) -> None:
    views = report.views
    expected = views["expected_inliers"].to_numpy(np.float64)
    n_inliers = views["n_inliers"].to_numpy(np.float64)
    label = "expected inliers"
    if not np.isfinite(expected).all():
        expected = views["n_visible"].to_numpy(np.float64)
        label = "landmarks in view"
    good = views["good"].to_numpy(dtype=bool)
    most = 1.3 * max(float(expected.max(initial=1)), float(n_inliers.max(initial=1)), 10.0)
    axes.plot([1, most], [1, most], color=INK, linewidth=1, linestyle="--")
    for mask, color in ((good, _GOOD), (~good, _BAD)):
        axes.scatter(
            np.maximum(expected[mask], 0.5), np.maximum(n_inliers[mask], 0.5), s=9, color=color, alpha=0.6, linewidths=0
        )
    axes.set(xscale="log", yscale="log", xlabel=label, ylabel="inliers", title="expected and actual inliers")
    axes.set(xlim=(0.4, most), ylim=(0.4, most))


def _draw_blocks(axes: Axes, report: CheckReport) -> None:
    blocks = report.blocks
    at = np.arange(len(blocks))
    axes.bar(at, blocks["share_localized"], color=_GOOD, alpha=0.45, width=0.7, label="share that localizes")
    if report.numbers["ece"] is not None:
        axes.plot(at, blocks["mean_score"], color=INK, marker="o", linestyle="", markersize=5, label="predicted")
    axes.set_xticks(at, [f"{row.left_out}" for row in blocks.itertuples()])
    axes.set(ylim=(0, 1.02), ylabel="share of the views")
    first = int((blocks["kind"] == "part").sum())
    axes.set_xlabel(
        f"photographs held out ({first} blocks that partition all, {len(blocks) - first} grown ones)\n"
        "in the bars: landmarks of a photograph that the rest still has"
    )
    if 0 < first < len(blocks):
        axes.axvline(first - 0.5, color=INK, linewidth=0.8, linestyle=":")
    for place, row in enumerate(blocks.itertuples()):
        axes.annotate(f"{row.median_kept:.0f}", (place, 0.02), ha="center", fontsize=8)
    axes.set_title("blocks", loc="left", pad=22)
    axes.grid(axis="x", visible=False)
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.08), ncols=2, borderaxespad=0)
