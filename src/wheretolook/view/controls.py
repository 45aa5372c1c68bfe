"""The panel beside the scene: what one who looks can choose, and where is told what was found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from wheretolook.dataset.thresholds import THRESHOLDS, threshold_key, threshold_label
from wheretolook.utils.errors import ConfigError
from wheretolook.view.drawing import legend
from wheretolook.view.shared import STEP_M, Shared
from wheretolook.view.state import MOST_VIEWS, ViewState
from wheretolook.view.texts import plain

if TYPE_CHECKING:
    from viser import GuiApi

HINT = "Click a place on the coloured floor: the score of every direction there, and the best views."
LIMITS = {threshold_label(threshold_key(limits)): limits for limits in THRESHOLDS}
T = TypeVar("T")
FILES = {
    "CSV": ("csv", ".csv"),
    "JSON": ("json", ".json"),
    "TUM trajectory": ("tum", ".tum"),
    "COLMAP images.txt": ("colmap", ".txt"),
    "benchmark poses": ("benchmark", ".txt"),
}
"""Formats that waypoints are saved in, each with `wheretolook select`'s name of it and the file's ending."""


@dataclass
class Controls:
    """Handles of everything in the panel."""

    doubts: Any
    status: Any
    legend: Any
    method: Any
    weights: Any
    occlusion: Any
    height: Any
    threshold: Any
    cut: Any
    shown: dict[str, Any]
    limits: Any
    judged: Any
    n: Any
    told: Any
    view: Any
    yaw: Any
    pitch: Any
    through: Any
    picture: Any
    picture_told: Any
    path_told: dict[str, Any]
    path_pictures: dict[str, Any]
    step: Any
    play: Any
    placing: Any
    waypoints: Any
    add: Any
    clear: Any
    format: Any
    save: Any
    state: Any
    link: Any
    dark: Any
    photo: Any


def build(gui: GuiApi, shared: Shared, state: ViewState) -> Controls:
    """Make the panel for one client, as its state says."""
    opened = shared.opened
    made: dict[str, Any] = {}
    low = shared.low_m
    high = shared.high_m
    blank = np.full((270, 360, 3), (38, 40, 46), np.uint8)
    tabs = gui.add_tab_group()
    with tabs.add_tab("Look"):
        doubts = "\n\n".join(f"⚠ {plain(doubt[0].upper() + doubt[1:])}." for doubt in shared.doubts)
        made["doubts"] = gui.add_markdown(doubts, visible=bool(doubts))
        made["status"] = gui.add_markdown("")
        made["legend"] = gui.add_html(legend(0, 1, "score"))
        made["method"] = gui.add_dropdown("method", opened.methods, initial_value=state.method)
        made["weights"] = gui.add_markdown("")
        made["occlusion"] = gui.add_dropdown("hidden by", opened.occlusions, initial_value=state.occlusion)
        made["height"] = _slider(gui, "floor at, m", low, high, state.height)
        made["threshold"] = gui.add_slider(
            "good from", 0.0, 1.0, 0.01, _within(state.threshold, 0, 1), hint="Places and views below are paler."
        )
        with gui.add_folder("Place"):
            made["told"] = gui.add_markdown(HINT)
            made["n"] = gui.add_slider("best views", 1, MOST_VIEWS, 1, state.n)
            made["view"] = gui.add_slider("shown", 1, state.n if state.n > 1 else 2, 1, 1)
            made["yaw"] = gui.add_slider("yaw, °", -180.0, 180.0, 0.5, 0.0)
            made["pitch"] = gui.add_slider("pitch, °", -90.0, 90.0, 0.5, 0.0)
            made["through"] = gui.add_checkbox(
                "look through it", False, hint="Stand at the place: drag to turn, and the score follows."
            )
            made["picture"] = gui.add_image(blank, visible=False)
            made["picture_told"] = gui.add_markdown("")
        with gui.add_folder("Shown", expand_by_default=False):
            made["cut"] = _slider(gui, "cut above, m", *_span(shared), state.cut)
            has = {"mesh": opened.mesh is not None, "cameras": opened.mapping_poses is not None}
            names = {"mesh": opened.mesh is not None, "landmarks": opened.mesh is None}
            names |= {"floor": True, "cameras": False, "labels": False}
            has["labels"] = opened.labels is not None
            made["shown"] = {
                name: gui.add_checkbox(name, on, disabled=not has.get(name, True)) for name, on in names.items()
            }
            made["limits"] = gui.add_dropdown("labels within", tuple(LIMITS), visible=has["labels"])
            made["judged"] = gui.add_markdown("", visible=has["labels"])
    made |= {"path_told": {}, "path_pictures": {}, "step": None, "play": None}
    if shared.paths:
        with tabs.add_tab("Path"):
            n = max(map(len, shared.paths.values()))
            made["play"] = gui.add_button("Play")
            made["step"] = gui.add_slider("step", 1, n, 1, 1)
            for name in shared.paths:
                made["path_told"][name] = gui.add_markdown(f"**{plain(name)}**")
                made["path_pictures"][name] = gui.add_image(blank)
    with tabs.add_tab("Waypoints"):
        made["placing"] = gui.add_checkbox("clicks set waypoints", False)
        made["waypoints"] = gui.add_markdown("No waypoints yet.")
        made["add"] = gui.add_button("Add the place looked at")
        made["clear"] = gui.add_button("Remove all")
        made["format"] = gui.add_dropdown("format", tuple(FILES))
        made["save"] = gui.add_button("Save with best views")
    with tabs.add_tab("Share"):
        made["photo"] = gui.add_button("Save a picture")
        made["dark"] = gui.add_checkbox("dark", False)
        made["link"] = gui.add_markdown("")
        made["state"] = gui.add_text("state", state.text(), hint="For wheretolook view --state.")
    return Controls(**made)


def _span(shared: Shared) -> tuple[float, float]:
    """From the lowest to the highest of what is shown."""
    points = shared.opened.landmarks.points[:, 2]
    low = float(points.min())
    high = float(points.max())
    if shared.opened.mesh is not None:
        low, high = (float(z) for z in shared.opened.mesh.bounds[:, 2])
    return low, max(high, low + 2 * STEP_M)


def _slider(gui: GuiApi, label: str, low: float, high: float, value: float | None) -> Any:
    low = np.floor(low / STEP_M) * STEP_M
    high = np.ceil(high / STEP_M) * STEP_M
    high = max(high, low + STEP_M)
    chosen = high if value is None else round(_within(value, low, high) / STEP_M) * STEP_M
    return gui.add_slider(label, round(low, 3), round(high, 3), STEP_M, round(_within(chosen, low, high), 3))


def _within(value: float, low: float, high: float) -> float:
    return float(min(max(value, low), high))


def check_value(handle: Any, before: Any) -> None:
    """Raise ConfigError if a client has set a control to what it does not offer, and set it to what it was before."""
    value = getattr(handle, "value", None)
    if _offers(handle, value):
        return
    handle.value = before
    raise ConfigError("this control has no such value", value=value, fix="Choose one that it offers.")


def value_of(handle: Any, known: T) -> T:
    """The value of a control; what is known instead, while a client has set it to what it does not offer.

    Callbacks come in several threads: another control's can read it before its own has put it back (`check_value`).
    """
    value = handle.value
    return value if _offers(handle, value) else known


def _offers(handle: Any, value: Any) -> bool:
    options = getattr(handle, "options", None)
    most = getattr(handle, "max", None)
    return bool((options is None or value in options) and (most is None or handle.min <= value <= most))
