"""The panel of one client: controls, and texts and images that report results."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from wheretolook.dataset.thresholds import THRESHOLDS, threshold_key, threshold_label
from wheretolook.utils.errors import ConfigError
from wheretolook.view.drawing import escape_markdown, legend
from wheretolook.view.shared import STEP_M, Shared
from wheretolook.view.state import MAX_VIEWS, ViewState

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
"""Formats of saved views: the name in `wheretolook select` and the file name suffix of each."""
_BLANK = np.full((270, 360, 3), (38, 40, 46), np.uint8)


class Controls:
    """Handles of all elements of the panel, which is made by a `viser.GuiApi`."""

    def __init__(self, gui: Any, shared: Shared, state: ViewState) -> None:
        tabs = gui.add_tab_group()
        with tabs.add_tab("Look"):
            self._add_map(gui, shared, state)
            with gui.add_folder("Place"):
                self._add_location(gui, state)
            with gui.add_folder("Shown", expand_by_default=False):
                self._add_layers(gui, shared, state)
        self.step: Any = None
        self.play: Any = None
        self.path_captions: dict[str, Any] = {}
        self.path_pictures: dict[str, Any] = {}
        if shared.paths:
            with tabs.add_tab("Path"):
                self._add_paths(gui, shared)
        with tabs.add_tab("Waypoints"):
            self._add_waypoints(gui)
        with tabs.add_tab("Share"):
            self._add_share(gui, state)

    def _add_map(self, gui: Any, shared: Shared, state: ViewState) -> None:
        viewed = shared.viewed
        warnings = "\n\n".join(f"⚠ {escape_markdown(text[0].upper() + text[1:])}." for text in viewed.warnings)
        self.warnings = gui.add_markdown(warnings, visible=bool(warnings))
        self.status = gui.add_markdown("")
        self.legend = gui.add_html(legend(0, 1, "score"))
        self.method = gui.add_dropdown("method", viewed.methods, initial_value=state.method)
        self.weights = gui.add_markdown("")
        self.occlusion = gui.add_dropdown("hidden by", viewed.occlusions, initial_value=state.occlusion)
        self.height = _height_slider(gui, "floor at, m", shared.low_m, shared.high_m, state.height)
        threshold = _clamp(state.threshold, 0, 1)
        hint = "Places and views below are paler."
        self.threshold = gui.add_slider("good from", 0.0, 1.0, 0.01, threshold, hint=hint)

    def _add_location(self, gui: Any, state: ViewState) -> None:
        self.summary = gui.add_markdown(HINT)
        self.n = gui.add_slider("best views", 1, MAX_VIEWS, 1, state.n)
        self.view = gui.add_slider("shown", 1, max(2, state.n), 1, 1)
        self.yaw = gui.add_slider("yaw, °", -180.0, 180.0, 0.5, 0.0)
        self.pitch = gui.add_slider("pitch, °", -90.0, 90.0, 0.5, 0.0)
        hint = "Stand at the place: drag to turn, and the score follows."
        self.inside = gui.add_checkbox("look through it", False, hint=hint)
        self.picture = gui.add_image(_BLANK, visible=False)
        self.picture_caption = gui.add_markdown("")

    def _add_layers(self, gui: Any, shared: Shared, state: ViewState) -> None:
        viewed = shared.viewed
        z = viewed.landmarks.points[:, 2] if viewed.mesh is None else viewed.mesh.bounds[:, 2]
        low = float(z.min())
        self.cut = _height_slider(gui, "cut above, m", low, max(float(z.max()), low + 2 * STEP_M), state.cut)
        has_mesh = viewed.mesh is not None
        has_labels = viewed.labels is not None
        self.layers = {
            "mesh": gui.add_checkbox("mesh", has_mesh, disabled=not has_mesh),
            "landmarks": gui.add_checkbox("landmarks", not has_mesh),
            "floor": gui.add_checkbox("floor", True),
            "cameras": gui.add_checkbox("cameras", False, disabled=viewed.mapping_poses is None),
            "labels": gui.add_checkbox("labels", False, disabled=not has_labels),
        }
        self.limits = gui.add_dropdown("labels within", tuple(LIMITS), visible=has_labels)
        self.label_summary = gui.add_markdown("", visible=has_labels)

    def _add_paths(self, gui: Any, shared: Shared) -> None:
        self.play = gui.add_button("Play")
        self.step = gui.add_slider("step", 1, max(map(len, shared.paths.values())), 1, 1)
        for name in shared.paths:
            self.path_captions[name] = gui.add_markdown(f"**{escape_markdown(name)}**")
            self.path_pictures[name] = gui.add_image(_BLANK)

    def _add_waypoints(self, gui: Any) -> None:
        self.placing = gui.add_checkbox("clicks set waypoints", False)
        self.waypoints = gui.add_markdown("No waypoints yet.")
        self.add = gui.add_button("Add the place looked at")
        self.clear = gui.add_button("Remove all")
        self.format = gui.add_dropdown("format", tuple(FILES))
        self.save = gui.add_button("Save with best views")

    def _add_share(self, gui: Any, state: ViewState) -> None:
        self.photo = gui.add_button("Save a picture")
        self.dark = gui.add_checkbox("dark", False)
        self.link = gui.add_markdown("")
        self.state = gui.add_text("state", state.text(), hint="For wheretolook view --state.")


def _height_slider(gui: Any, label: str, low: float, high: float, value: float | None) -> Any:
    low = round(np.floor(low / STEP_M) * STEP_M, 3)
    high = round(max(np.ceil(high / STEP_M) * STEP_M, low + STEP_M), 3)
    chosen = high if value is None else round(_clamp(value, low, high) / STEP_M) * STEP_M
    return gui.add_slider(label, low, high, STEP_M, round(_clamp(chosen, low, high), 3))


def _clamp(value: float, low: float, high: float) -> float:
    return float(min(max(value, low), high))


def check_value(handle: Any, previous: Any) -> None:
    """Raise ConfigError and restore the previous value if a client has set a control to an invalid one."""
    value = getattr(handle, "value", None)
    if not _is_valid(handle, value):
        handle.value = previous
        raise ConfigError("this control has no such value", value=value, fix="Choose one that it offers.")


def value_of(handle: Any, default: T) -> T:
    """Return the value of a control, or a default while a client has set it to an invalid one.

    Callbacks run in several threads: one can read a control before its own callback has restored it.
    """
    value = handle.value
    return value if _is_valid(handle, value) else default


def _is_valid(handle: Any, value: Any) -> bool:
    options = getattr(handle, "options", None)
    high = getattr(handle, "max", None)
    return bool((options is None or value in options) and (high is None or handle.min <= value <= high))
