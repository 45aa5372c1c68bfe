"""One browser client: its controls, state and queued work."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Coroutine, Hashable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from wheretolook.dataset.config import THRESHOLDS, threshold_key, threshold_label
from wheretolook.geometry.poses import Float, quaternion_from_rotation
from wheretolook.geometry.similarity import local_origin
from wheretolook.utils.errors import ConfigError, WhereToLookError
from wheretolook.view import drawing
from wheretolook.view.state import MAX_VIEWS, ViewState
from wheretolook.view.viewed_map import ScoredLocation, ViewedMap

if TYPE_CHECKING:
    from viser import ClientHandle

    from wheretolook.select.where_to_look import WhereToLook

NOW = 0
SOON = 1
LATER = 2
"""Urgencies: a view turned by hand, a clicked location, the floor."""

PATIENCE_S = 4.0  # a LATER job precedes others if none has run for this long

CLICK_PATIENCE_S = 1.0  # a SOON job precedes NOW jobs if none has run for this long

LIMITS = {threshold_label(threshold_key(limits)): limits for limits in THRESHOLDS}
STEP_M = 0.05  # of heights
_log = logging.getLogger(__name__)


@dataclass(eq=False)
class _Job:
    key: tuple[Hashable, Hashable]  # owner and kind
    urgency: int
    steps: Iterator[object]
    on_error: Callable[[Exception], None]


class Worker:
    """Runs jobs, each an iterator, one step at a time in one thread, since scorers are not thread-safe.

    Before each step the most urgent job is chosen; equally urgent jobs alternate. A job that raises ends, and its
    `on_error` is called.
    """

    def __init__(self, name: str = "scores") -> None:
        self._jobs: dict[tuple[Hashable, Hashable], _Job] = {}  # the next of each urgency first
        self._last_run = [-math.inf] * 3  # by urgency
        self._changed = threading.Condition()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(
        self,
        owner: Hashable,
        kind: Hashable,
        urgency: int,
        steps: Iterator[object],
        on_error: Callable[[Exception], None],
    ) -> None:
        """Queue a job of an owner. It replaces the pending job of the same owner and kind."""
        job = _Job((owner, kind), urgency, steps, on_error)
        with self._changed:
            self._jobs.pop(job.key, None)
            self._jobs[job.key] = job
            self._changed.notify()

    def forget(self, owner: Hashable) -> None:
        """Drop all jobs of an owner."""
        with self._changed:
            self._jobs = {key: job for key, job in self._jobs.items() if key[0] != owner}

    def stop(self, wait: bool = True) -> None:
        """End the thread after its current step, and by default wait for it."""
        with self._changed:
            self._stopped = True
            self._changed.notify()
        if wait:
            self._thread.join(timeout=10)

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._jobs and not self._stopped:
                    self._changed.wait()
                if self._stopped:
                    return
                job = self._next_job()
                # not within 0.4 s of a NOW job, since the next one would wait for the step
                start = min(self._last_run[NOW] + 0.4, self._last_run[LATER] + PATIENCE_S)
                pause_s = start - time.monotonic()
                if job.urgency == LATER and pause_s > 0:
                    self._changed.wait(pause_s)
                    continue
            finished = self._step(job)
            self._last_run[job.urgency] = time.monotonic()
            with self._changed:
                if self._jobs.get(job.key) is job:
                    del self._jobs[job.key]
                    if not finished:
                        self._jobs[job.key] = job  # behind the others

    def _next_job(self) -> _Job:
        """Return the first of the most urgent jobs, or of less urgent ones that have waited too long."""
        now = time.monotonic()
        patience_s = (math.inf, CLICK_PATIENCE_S, PATIENCE_S)

        def order(job: _Job) -> tuple[bool, int]:
            overdue = now - self._last_run[job.urgency] > patience_s[job.urgency]
            return not overdue, job.urgency

        return min(self._jobs.values(), key=order)

    def _step(self, job: _Job) -> bool:
        """Run a step of a job; return whether the job has ended."""
        try:
            next(job.steps)
            return False
        except StopIteration:
            return True
        except Exception as error:  # must not end the thread
            _log.debug("a job failed: %s", job.key, exc_info=error)
            try:
                job.on_error(error)
            except Exception:
                _log.exception("an error could not be reported")
            return True


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
        warnings = "\n\n".join(f"⚠ {drawing.escape_markdown(text[0].upper() + text[1:])}." for text in viewed.warnings)
        self.warnings = gui.add_markdown(warnings, visible=bool(warnings))
        self.status = gui.add_markdown("")
        self.legend = gui.add_html(drawing.legend(0, 1))
        self.method = gui.add_dropdown("method", viewed.weights.methods, initial_value=state.method)
        self.weights = gui.add_markdown("")
        self.occlusion = gui.add_dropdown("occlusion model", viewed.occlusions, initial_value=state.occlusion)
        self.height = _height_slider(gui, "camera height", viewed.bounds[:, 2], state.height)
        self.height.hint = "Height z in metres at which locations are scored and selected."
        threshold = min(max(state.threshold, 0.0), 1.0)
        hint = "Locations with lower scores are paler."
        self.threshold = gui.add_slider("threshold", 0.0, 1.0, 0.01, threshold, hint=hint)
        names = [
            f'<span style="color:rgb{drawing.path_color(number)}">■</span> {drawing.escape_markdown(name)}'
            for number, name in enumerate(viewed.paths)
        ]
        self.paths = gui.add_markdown(f"Paths: {', '.join(names)}", visible=bool(names))

    def _add_location(self, gui: Any, state: ViewState) -> None:
        self.summary = gui.add_markdown(
            "Click a location on the coloured floor for the score of every direction and the best views."
        )
        self.n = gui.add_slider("best views", 1, MAX_VIEWS, 1, state.n)
        self.view = gui.add_slider("selected view", 1, max(2, state.n), 1, 1)
        self.yaw = gui.add_slider("yaw, degrees", -180.0, 180.0, 0.5, 0.0)
        self.pitch = gui.add_slider("pitch, degrees", -90.0, 90.0, 0.5, 0.0)
        hint = "Move to the selected view; drag to turn it."
        self.inside = gui.add_checkbox("first person", False, hint=hint)
        self.picture = gui.add_image(np.full((270, 360, 3), (38, 40, 46), np.uint8), visible=False)
        self.picture_legend = gui.add_html(
            drawing.legend(0, 1, "probability that a landmark is detected"), visible=False
        )
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


class Session:
    """One client. Its callbacks record choices in its own thread; computations run in the shared worker."""

    def __init__(self, client: ClientHandle, viewed: ViewedMap, worker: Worker, state: ViewState, host: str) -> None:
        self.client = client
        self.scene = client.scene
        self.viewed = viewed
        self.worker = worker
        self.host = host
        self.state = viewed.complete(state)
        if state.cut is None and viewed.mesh is not None:
            top = float(viewed.mesh.bounds[1, 2])
            # a mesh is cut above the camera by default
            self.state = replace(self.state, cut=min((self.state.height or 0.0) + 0.35, top))
        self.location: ScoredLocation | None = None  # selected
        self.controls = Controls(client.gui, viewed, self.state)
        self.closed = False
        self._lock = threading.Lock()
        self._inbox = Worker(f"client {client.client_id}")
        self._notified = -math.inf  # time of the last error notification

    @property
    def selector(self) -> WhereToLook:
        """The view selector of the chosen method and occlusion model; for the worker thread."""
        return self.viewed.selector(self.state.method, self.state.occlusion)

    @property
    def fov(self) -> float:
        """The vertical field of view of the map's camera in radians, without distortion."""
        camera = self.viewed.camera
        return 2 * float(np.arctan(camera.height / 2 / camera.mean_focal_px))

    def on(self, handle: Any, action: Callable[[], None], by_hand: bool = False) -> None:
        """Call `action` when a control changes or is clicked, optionally only if the client changed it.

        Errors go to the client; invalid values are replaced by the previous one.
        """
        previous = [getattr(handle, "value", None)]

        def checked(_: object) -> None:
            try:
                previous[0] = value_of(handle)
            except ConfigError:
                handle.value = previous[0]
                raise
            action()

        event = handle.on_click if hasattr(handle, "on_click") else handle.on_update
        event(self.callback(checked, by_hand))

    def callback(
        self, action: Callable[[Any], None], by_hand: bool = False
    ) -> Callable[[Any], Coroutine[Any, Any, None]]:
        """Wrap an action on an event for viser: it runs in this client's thread, for the newest event only.

        viser runs plain functions in threads that all clients share, where one client's flood of events would delay
        the others; so this is a coroutine.
        """
        kind = object()

        async def enqueue(event: Any) -> None:
            if not (by_hand and event.client is None):
                self._inbox.submit(self.client.client_id, kind, NOW, once(lambda: action(event)), self.show_error)

        return enqueue

    def submit(self, kind: str, urgency: int, steps: Iterator[object]) -> None:
        """Queue a computation for this client in place of the pending one of that kind."""
        if not self.closed:
            self.worker.submit(self.client.client_id, kind, urgency, steps, self.show_error)

    def show_error(self, error: Exception) -> None:
        """Notify the client of an error, at most once every half second."""
        now = time.monotonic()
        if self.closed or now - self._notified < 0.5:
            return
        self._notified = now
        text = str(error)
        if not isinstance(error, WhereToLookError):
            _log.error("the viewer failed", exc_info=error)
            text = f"{type(error).__name__}: {error}. See the terminal."
        self.client.add_notification("That did not work", text, color="red", auto_close_seconds=15)
        if self.location is None:
            self.controls.summary.content = drawing.escape_markdown(text)

    def update(self, **changes: Any) -> None:
        """Change fields of the state; thread-safe."""
        with self._lock:
            self.state = replace(self.state, **changes)

    def show_state(self) -> None:
        """Show the state as text and link."""
        text = self.state.text()
        if self.controls.state.value != text:
            self.controls.state.value = text
            self.controls.link.content = f"[A link to this view]({self.state.link(self.host)})"

    def add_points(self, name: str, points: Float, colors: Any, size_m: float, visible: bool = True) -> None:
        """Draw points (N, 3) m, or nothing without any.

        Coordinates are sent relative to their mean, since single precision is coarse far away.
        """
        if len(points) == 0:
            self.scene.remove_by_name(name)
            return
        center = points.mean(0)
        self.scene.add_point_cloud(
            name,
            (points - center).astype(np.float32),
            colors,
            point_size=size_m,
            point_shape="circle",
            precision="float32",
            position=center,
            point_shading="flat",
            visible=visible,
        )

    def add_lines(self, name: str, segments: Float, colors: Any, thickness: float) -> None:
        """Draw lines between pairs of points (S, 2, 3) m, in one colour or those of their ends (S, 2, 3).

        As for points, coordinates are sent relative to an origin nearby.
        """
        origin = local_origin(segments.reshape(-1, 3))
        self.scene.add_line_segments(
            name, segments - origin, colors, thickness=thickness, thickness_units="screen", position=origin
        )

    def add_frustum(self, name: str, pose: Float, markers: float, color: tuple[int, int, int], **options: Any) -> None:
        """Draw the frustum of a camera pose (3, 4), `markers` times as large as a marker."""
        camera = self.viewed.camera
        rotation = pose[:, :3].T
        self.scene.add_camera_frustum(
            name,
            self.fov,
            camera.width / camera.height,
            scale=markers * self.viewed.marker_m,
            color=color,
            wxyz=quaternion_from_rotation(rotation),
            position=-rotation @ pose[:, 3],
            thickness_units="screen",
            cast_shadow=False,
            receive_shadow=False,
            **options,
        )

    def close(self) -> None:
        """Stop all work for this client."""
        self.closed = True
        self._inbox.stop(wait=False)
        self.worker.forget(self.client.client_id)


def once(action: Callable[[], None]) -> Iterator[None]:
    """Make a job of one step."""
    action()
    yield
