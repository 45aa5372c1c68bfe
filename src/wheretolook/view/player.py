"""Play paths for one client: each method's camera along its path, and its image, side by side."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from wheretolook.geometry.poses import camera_centers
from wheretolook.utils.texts import counted
from wheretolook.view.controls import value_of
from wheretolook.view.drawing import escape_markdown
from wheretolook.view.session import Session
from wheretolook.view.worker import SOON

if TYPE_CHECKING:
    from wheretolook.scorers.base import ViewReport

STEP_S = 0.25  # minimum time of a step
COLORS = ((120, 120, 120), (213, 94, 0), (0, 114, 178), (0, 158, 115), (204, 121, 167))

LOCALIZED = ' <span style="color:#009E73">● localized</span>'
LOST = ' <span style="color:#D55E00">● lost</span>'
LIKELY_LOST = ' <span style="color:#D55E00">● likely lost</span>'


class Player:
    """Moves the cameras of all paths step by step; the camera of a shorter path waits at its end."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.paths = session.viewed.paths
        self.length = max(map(len, self.paths.values()))
        self._colors = {name: COLORS[k % len(COLORS)] for k, name in enumerate(self.paths)}
        self._reports: dict[tuple[str, str, str], ViewReport] = {}  # by path, method and occlusion model
        self._playing = False
        self._timer: threading.Timer | None = None  # for the next step
        for name, path in self.paths.items():
            line = camera_centers(path.cam_from_world)
            session.add_lines(f"/path/{name}", np.stack([line[:-1], line[1:]], axis=1), self._colors[name], 4.0)
        controls = session.controls
        for handle in (controls.step, controls.method, controls.occlusion):
            session.on(handle, self.show)
        session.on(controls.play, self.toggle)
        self.show()

    def toggle(self) -> None:
        """Play or pause."""
        self._playing = not self._playing
        self.session.controls.play.label = "Pause" if self._playing else "Play"
        if self._playing:
            self._next_step()

    def _next_step(self) -> None:
        """Move the slider, whose callback shows the step; after the last step comes the first."""
        slider = self.session.controls.step
        if self._playing and not self.session.closed:
            slider.value = int(value_of(slider)) % self.length + 1

    def show(self) -> None:
        """Queue the drawing of a step of all paths."""
        self.session.submit("path", SOON, self._show(int(value_of(self.session.controls.step)) - 1))

    def _show(self, step: int) -> Iterator[None]:
        begin = time.monotonic()
        session = self.session
        state = session.state
        for name, path in self.paths.items():
            key = (name, state.method, state.occlusion)
            if key not in self._reports:
                self._reports[key] = session.selector.scorer.report(path.cam_from_world)
                yield
            report = self._reports[key]
            row = min(step, len(path) - 1)
            pose = path.cam_from_world[row]
            landmarks = session.viewed.visible_landmarks(state.method, state.occlusion, pose)
            image, _ = session.viewed.picture(pose, landmarks)
            session.add_frustum(f"/path/{name}/camera", pose, 2.0, self._colors[name], image=image, thickness=3.0)
            score = float(report.score[row])
            caption = f"**{escape_markdown(name)}**: score {score:.3g}, {counted(report.n_visible[row], 'landmark')}"
            if path.localized is not None:
                caption += LOCALIZED if path.localized[row] else LOST
            elif session.viewed.is_probability(state.method) and score < state.threshold:
                caption += LIKELY_LOST
            session.controls.path_captions[name].content = caption
            session.controls.path_pictures[name].image = image
            yield
        if self._playing and step + 1 < self.length:
            self._schedule(STEP_S - (time.monotonic() - begin))
        elif self._playing:
            self.toggle()

    def _schedule(self, delay_s: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = threading.Timer(max(0.0, delay_s), self._next_step)
        self._timer.daemon = True
        self._timer.start()
