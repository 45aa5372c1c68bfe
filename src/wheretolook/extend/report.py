"""Files of audits and of planned photographs: heat maps, mounts, tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.style import context

from wheretolook.extend.audit import Audit
from wheretolook.figures.floor_plan import (
    BLUE,
    GREY,
    INK,
    RC,
    VERMILION,
    label_plan,
    new_figure,
    plan_extent,
    save_figure,
)
from wheretolook.geometry.poses import Float
from wheretolook.geometry.views import Views
from wheretolook.mapping.map_frame import MapFrame
from wheretolook.utils.files import write_json, write_text


def heat_maps(
    landmarks: Float, maps: Sequence[tuple[str, Float, Float]], frame: MapFrame, photographs: Views | None = None
) -> Figure:
    """Draw plans of landmarks (N, 3) in the world side by side, each with a title and shares (W,) at places (W, 3).

    Photographs, in the map's own frame, are numbered arrows.
    """
    to_world = frame.world_from_map

    def upright(points: Float) -> Float:
        """Return points in the world in the map's unit, turned about its origin only."""
        return to_world.inverse.apply(points) @ to_world.rotation.T

    points = upright(landmarks)
    low, high = plan_extent(points, upright(np.concatenate([places for _, places, _ in maps])))
    width, height = np.maximum((high - low) / (high - low).max(), 0.3)
    with context(RC):
        figure = new_figure(1 + len(maps) * (0.8 + 5.5 * width), 1 + 5.5 * height)
        plans = figure.subplots(1, len(maps), squeeze=False)[0]
        for plan, (title, places, shares) in zip(plans, maps, strict=True):
            plan.scatter(*points[:: len(points) // 20_000 + 1, :2].T, s=1, color=GREY, alpha=0.3, linewidths=0)
            at = upright(places)
            shown = plan.scatter(*at[:, :2].T, c=shares, s=60, marker="s", cmap="cividis", vmin=0, vmax=1, alpha=0.85)
            plan.set(aspect="equal", title=title, xlim=(low[0], high[0]), ylim=(low[1], high[1]))
            label_plan(plan, frame, low, float((high - low).max()))
            if photographs is not None:
                _draw_photographs(plan, photographs, float(np.linalg.norm(high - low)))
        figure.colorbar(shown, ax=plans.tolist(), shrink=0.7, label="share of target views that localize")
        return figure


def _draw_photographs(plan: Axes, photographs: Views, size: float) -> None:
    to_world = photographs.frame.world_from_map
    positions = photographs.positions @ to_world.rotation.T
    arrows = 0.05 * size * photographs.axes @ to_world.rotation.T
    plan.quiver(
        *positions[:, :2].T, *arrows[:, :2].T, color=VERMILION, angles="xy", scale_units="xy", scale=1, width=0.006
    )
    for name, position in zip(photographs.waypoint_id, positions, strict=True):
        plan.annotate(name, position[:2], (3, 3), textcoords="offset points", fontsize=8, color=INK)


def places_and_shares(views: Views, shares: Float) -> tuple[Float, Float]:
    """Return the places (W, 3) of target views in the world, and the mean of shares (T,) at each (W,)."""
    rows, first = np.unique(views.waypoint, return_index=True)
    sums = np.bincount(views.waypoint, shares)[rows]
    return views.positions[first], sums / np.bincount(views.waypoint)[rows]


def mount_figure(mounts: pd.DataFrame) -> Figure:
    """Draw the share of target views that localize over the pitch of the camera, a line for each height."""
    with context(RC):
        figure = new_figure(5.5, 3.8)
        plan = figure.add_subplot()
        for number, (height, rows) in enumerate(mounts.groupby("height_m", dropna=False)):
            color = (BLUE, VERMILION, INK, GREY)[number % 4]
            label = "height of the cameras" if height != height else f"{height:g} m"
            errors = np.abs(rows[["share_low", "share_high"]].to_numpy().T - rows["share"].to_numpy())
            plan.errorbar(rows["pitch_deg"], rows["share"], errors, color=color, marker="o", capsize=3, label=label)
        plan.set(xlabel="pitch (degrees)", ylabel="share of target views that localize", ylim=(0, 1))
        plan.legend(title="height")
        return figure


def save_audits(audits: dict[str, Audit], mounts: pd.DataFrame, landmarks: Float, out: Path) -> None:
    """Write audit.csv, audit.json and audit.png, of several maps together, and of several mounts mounts.csv and .png."""
    tables = [audit.of_places().assign(map=name) for name, audit in audits.items()]
    table = pd.concat(tables, ignore_index=True)
    write_text(out / "audit.csv", table.to_csv(index=False, lineterminator="\n", float_format="%.6g"))
    write_json(out / "audit.json", {name: audit.record() for name, audit in audits.items()})
    maps = []
    for name, audit in audits.items():
        title = f"{name}: {100 * audit.share:.0f} % localize"
        maps.append((title, *places_and_shares(audit.views, audit.views.score)))
    frame = next(iter(audits.values())).views.frame
    save_figure(heat_maps(landmarks, maps, frame), out / "audit.png")
    if len(mounts) > 1:
        write_text(out / "mounts.csv", mounts.to_csv(index=False, lineterminator="\n", float_format="%.6g"))
        save_figure(mount_figure(mounts), out / "mounts.png")
