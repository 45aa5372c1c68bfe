"""Files of audits and of planned photographs: heat maps, mounts, tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
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
    landmarks: Float, maps: dict[str, tuple[Views, Float]], frame: MapFrame, photographs: Views | None = None
) -> Figure:
    """Draw plans of landmarks (N, 3) in the world side by side, each with its title, target views and their shares (T,).

    Views are in the map's own frame; photographs are numbered arrows.
    """
    rotation = frame.world_from_map.rotation.T
    points = frame.world_from_map.inverse.apply(landmarks) @ rotation
    low, high = plan_extent(points, np.concatenate([views.positions @ rotation for views, _ in maps.values()]))
    width, height = np.maximum((high - low) / (high - low).max(), 0.3)
    with context(RC):
        figure = new_figure(1 + len(maps) * (0.8 + 5.5 * width), 1 + 5.5 * height)
        plans = figure.subplots(1, len(maps), squeeze=False)[0]
        for plan, (title, (views, shares)) in zip(plans, maps.items(), strict=True):
            plan.scatter(*points[:: len(points) // 20_000 + 1, :2].T, s=1, color=GREY, alpha=0.3, linewidths=0)
            rows, first, n = np.unique(views.waypoint, return_index=True, return_counts=True)
            x, y, _ = (views.positions[first] @ rotation).T
            means = np.bincount(views.waypoint, shares)[rows] / n
            shown = plan.scatter(x, y, c=means, s=60, marker="s", cmap="cividis", vmin=0, vmax=1, alpha=0.85)
            plan.set(aspect="equal", title=title, xlim=(low[0], high[0]), ylim=(low[1], high[1]))
            label_plan(plan, frame, low, float((high - low).max()))
            if photographs is not None:
                at = (photographs.positions @ rotation)[:, :2]
                arrows = 0.05 * float(np.linalg.norm(high - low)) * (photographs.axes @ rotation)[:, :2]
                style = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.006}
                plan.quiver(*at.T, *arrows.T, color=VERMILION, **style)
                for name, position in zip(photographs.waypoint_id, at, strict=True):
                    plan.annotate(name, position, (3, 3), textcoords="offset points", fontsize=8)
        figure.colorbar(shown, ax=plans.tolist(), shrink=0.7, label="share of target views that localize")
        return figure


def mount_figure(mounts: pd.DataFrame) -> Figure:
    """Draw the share of target views that localize over the pitch of the camera, a line for each height."""
    with context(RC):
        figure = new_figure(5.5, 3.8)
        plan = figure.add_subplot()
        for number, (_, rows) in enumerate(mounts.groupby("height_m", dropna=False)):
            color = (BLUE, VERMILION, INK, GREY)[number % 4]
            of_cameras = rows["height_m"].isna().any()
            label = "that of the cameras" if of_cameras else f"{rows['height_m'].iloc[0]:g} m"
            errors = np.abs(rows[["share_low", "share_high"]].to_numpy().T - rows["share"].to_numpy())
            plan.errorbar(rows["pitch_deg"], rows["share"], errors, color=color, marker="o", capsize=3, label=label)
        plan.set(xlabel="pitch (degrees)", ylabel="share of target views that localize", ylim=(0, 1))
        plan.legend(title="height")
        return figure


def percent(share: float, low: float, high: float) -> str:
    """Return a share in per cent with its interval, without it if that is unknown (NaN)."""
    interval = "" if np.isnan(low) else f" [{100 * low:.1f}, {100 * high:.1f}]"
    return f"{100 * share:.1f} %{interval}"


def save_audits(audits: dict[str, Audit], mounts: pd.DataFrame, landmarks: Float, out: Path) -> None:
    """Write audit.csv, audit.json and audit.png, of several maps together, and of several mounts mounts.csv and .png."""
    table = pd.concat([audit.places().assign(map=name) for name, audit in audits.items()])
    write_text(out / "audit.csv", table.to_csv(index=False, lineterminator="\n", float_format="%.6g"))
    write_json(out / "audit.json", {name: audit.record() for name, audit in audits.items()})
    maps = {f"{name}: {100 * one.share:.0f} % localize": (one.views, one.views.score) for name, one in audits.items()}
    save_figure(heat_maps(landmarks, maps, next(iter(audits.values())).views.frame), out / "audit.png")
    if len(mounts) > 1:
        write_text(out / "mounts.csv", mounts.to_csv(index=False, lineterminator="\n", float_format="%.6g"))
        save_figure(mount_figure(mounts), out / "mounts.png")
