"""Play paths for one client: each method's camera along its path, and its image, side by side."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from wheretolook.geometry.poses import camera_centers, quaternion_from_rotation
from wheretolook.view.controls import value_of
from wheretolook.view.drawing import escape_markdown
from wheretolook.view.scores import visible_landmarks
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
        self.paths = session.shared.paths
        self.length = max(map(len, self.paths.values()))
        self._colors = {name: COLORS[k % len(COLORS)] for k, name in enumerate(self.paths)}
        self._reports: dict[tuple[str, str, str], ViewReport] = {}  # by path, method and occlusion model
        self._playing = threading.Event()
        self._shown = threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None  # at most one, however often the button is pressed
        for name, path in self.paths.items():
            line = camera_centers(path.cam_from_world)
            segments = np.stack([line[:-1], line[1:]], axis=1)
            color = self._colors[name]
            session.scene.add_line_segments(f"/path/{name}", segments, color, thickness=4.0, thickness_units="screen")
        controls = session.controls
        for handle in (controls.step, controls.method, controls.occlusion):
            session.on(handle, lambda: self.show(int(value_of(controls.step, 1)) - 1))
        session.on(controls.play, self.toggle, "on_click")
        self.show(0)

    def toggle(self) -> None:
        """Play or pause."""
        button = self.session.controls.play
        with self._lock:
            if self._playing.is_set():
                self._playing.clear()
                button.label = "Play"
                return
            self._playing.set()
            button.label = "Pause"
            if self._thread is None:
                self._thread = threading.Thread(target=self._play, daemon=True)
                self._thread.start()

    def _play(self) -> None:
        slider = self.session.controls.step
        step = int(value_of(slider, 1)) % self.length
        while not self._ended(step):
            start = time.monotonic()
            self._shown.clear()
            slider.value = step + 1  # its callback shows the step
            self._shown.wait(timeout=10)
            time.sleep(max(0.0, STEP_S - (time.monotonic() - start)))
            step += 1

    def _ended(self, step: int) -> bool:
        """Test whether to stop playing; if so, reset the button."""
        with self._lock:
            session = self.session
            if self._playing.is_set() and not session.closed and step < self.length:
                return False
            self._playing.clear()
            self._thread = None
            if not session.closed:
                session.controls.play.label = "Play"
            return True

    def show(self, step: int) -> None:
        """Queue the drawing of a step of all paths."""
        self.session.submit("path", SOON, self._show(min(max(step, 0), self.length - 1)))

    def _show(self, step: int) -> Iterator[None]:
        session = self.session
        state = session.state
        scorer = session.selector.scorer
        for name, path in self.paths.items():
            key = (name, state.method, state.occlusion)
            if key not in self._reports:
                self._reports[key] = scorer.report(path.cam_from_world)
                yield
            report = self._reports[key]
            row = min(step, len(path) - 1)
            pose = path.cam_from_world[row]
            landmarks = visible_landmarks(scorer, pose, session.shared.landmark_scorer(state.occlusion))
            image, _ = session.viewed.picture(pose, landmarks)
            wxyz = quaternion_from_rotation(pose[:, :3].T)
            camera = f"/path/{name}/camera"
            center = camera_centers(pose)
            session.add_frustum(camera, wxyz, center, 2.0, self._colors[name], image=image, thickness=3.0)
            score = float(report.score[row])
            caption = f"**{escape_markdown(name)}**: score {score:.3g}, {report.n_visible[row]:,} landmarks"
            if path.localized is not None:
                caption += LOCALIZED if path.localized[row] else LOST
            elif session.shared.is_probability(state.method) and score < state.threshold:
                caption += LIKELY_LOST
            session.controls.path_captions[name].content = caption
            session.controls.path_pictures[name].image = image
            yield
        self._shown.set()
