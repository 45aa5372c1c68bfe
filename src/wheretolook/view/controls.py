"""The panel of one client: controls, and texts and images that report results."""

from __future__ import annotations

from typing import Any

import numpy as np

from wheretolook.dataset.config import THRESHOLDS, threshold_key, threshold_label
from wheretolook.geometry.poses import Float
from wheretolook.utils.errors import ConfigError
from wheretolook.view.drawing import escape_markdown, legend
from wheretolook.view.state import MAX_VIEWS, ViewState
from wheretolook.view.viewed_map import ViewedMap

HINT = "Click a location on the coloured floor for the score of every direction and the best views."
LIMITS = {threshold_label(threshold_key(limits)): limits for limits in THRESHOLDS}
STEP_M = 0.05  # of heights
_BLANK = np.full((270, 360, 3), (38, 40, 46), np.uint8)


class Controls:
    """Handles of all elements of the panel, which is made by a `viser.GuiApi`."""

    def __init__(self, gui: Any, viewed: ViewedMap, state: ViewState) -> None:
        self.leave = gui.add_button("Leave first person", visible=False, color="orange")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Scene"):
            self._add_map(gui, viewed, state)
            with gui.add_folder("Location"):
                self._add_location(gui, state)
            with gui.add_folder("Layers", expand_by_default=False):
                self._add_layers(gui, viewed, state)
        with tabs.add_tab("Share"):
            self._add_share(gui, state)

    def _add_map(self, gui: Any, viewed: ViewedMap, state: ViewState) -> None:
        warnings = "\n\n".join(f"⚠ {escape_markdown(text[0].upper() + text[1:])}." for text in viewed.warnings)
        self.warnings = gui.add_markdown(warnings, visible=bool(warnings))
        self.status = gui.add_markdown("")
        self.legend = gui.add_html(legend(0, 1))
        self.method = gui.add_dropdown("method", viewed.weights.methods, initial_value=state.method)
        self.weights = gui.add_markdown("")
        self.occlusion = gui.add_dropdown("occlusion model", viewed.occlusions, initial_value=state.occlusion)
        self.height = _height_slider(gui, "camera height", viewed.bounds[:, 2], state.height)
        self.height.hint = "Height z in metres at which locations are scored and selected."
        threshold = min(max(state.threshold, 0.0), 1.0)
        hint = "Locations with lower scores are paler."
        self.threshold = gui.add_slider("threshold", 0.0, 1.0, 0.01, threshold, hint=hint)

    def _add_location(self, gui: Any, state: ViewState) -> None:
        self.summary = gui.add_markdown(HINT)
        self.n = gui.add_slider("best views", 1, MAX_VIEWS, 1, state.n)
        self.view = gui.add_slider("selected view", 1, max(2, state.n), 1, 1)
        self.yaw = gui.add_slider("yaw, degrees", -180.0, 180.0, 0.5, 0.0)
        self.pitch = gui.add_slider("pitch, degrees", -90.0, 90.0, 0.5, 0.0)
        hint = "Move to the selected view; drag to turn it."
        self.inside = gui.add_checkbox("first person", False, hint=hint)
        self.picture = gui.add_image(_BLANK, visible=False)
        self.picture_legend = gui.add_html(legend(0, 1, "probability that a landmark is detected"), visible=False)
        self.picture_caption = gui.add_markdown("")

    def _add_layers(self, gui: Any, viewed: ViewedMap, state: ViewState) -> None:
        z = viewed.landmarks.points[:, 2] if viewed.mesh is None else viewed.mesh.bounds[:, 2]
        self.cut = _height_slider(gui, "cut above, m", z, state.cut)
        has_mesh = viewed.mesh is not None
        has_labels = viewed.labels is not None
        self.layers = {
            "mesh": gui.add_checkbox("mesh", has_mesh, disabled=not has_mesh),
            "landmarks": gui.add_checkbox("landmarks", not has_mesh),
            "floor": gui.add_checkbox("floor", True),
            "cameras": gui.add_checkbox("cameras", False, disabled=viewed.mapping_poses is None),
            "labels": gui.add_checkbox("labels", False, disabled=not has_labels),
        }
        self.limits = gui.add_dropdown("localized within", tuple(LIMITS), visible=has_labels)
        self.label_summary = gui.add_markdown("", visible=has_labels)

    def _add_share(self, gui: Any, state: ViewState) -> None:
        self.dark = gui.add_checkbox("dark", False)
        self.link = gui.add_markdown("")
        self.state = gui.add_text("state", state.text(), hint="For wheretolook view --state.")


def _height_slider(gui: Any, label: str, heights: Float, value: float | None) -> Any:
    """Add a slider over the multiples of STEP_M that span heights, at a value or at its upper end."""
    first = np.floor(heights.min() / STEP_M)
    last = max(np.ceil(heights.max() / STEP_M), first + 1)
    step = last if value is None else np.clip(round(value / STEP_M), first, last)
    return gui.add_slider(label, *(round(float(k) * STEP_M, 3) for k in (first, last)), STEP_M, round(step * STEP_M, 3))


def value_of(handle: Any) -> Any:
    """Return the value of a control. Raises ConfigError if a client has set one that it does not offer.

    Callbacks run in several threads: one can read a control before its own callback has restored it.
    """
    value = handle.value
    options = getattr(handle, "options", (value,))
    high = getattr(handle, "max", None)
    if value not in options or not (high is None or handle.min <= value <= high):
        raise ConfigError("this control has no such value", value=value, fix="Choose one that it offers.")
    return value
