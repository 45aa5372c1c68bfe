"""Plays a path for one who looks: each method's camera along it, and what it sees, side by side."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from wheretolook.geometry.poses import Float, camera_centers, quaternion_from_rotation
from wheretolook.view.controls import value_of
from wheretolook.view.scores import landmarks_seen
from wheretolook.view.session import PATH_COLORS, Session
from wheretolook.view.texts import plain
from wheretolook.view.worker import SOON

if TYPE_CHECKING:
    from wheretolook.scorers.base import ViewReport

STEP_S = 0.25  # between two steps, at least

LOCALIZED = ' <span style="color:#009E73">● localized</span>'
LOST = ' <span style="color:#D55E00">● lost</span>'
LIKELY_LOST = ' <span style="color:#D55E00">● likely lost</span>'


class Player:
    """The cameras of all methods go from step to step together; one whose path is shorter waits at its end."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.paths = session.shared.paths
        self.length = max(map(len, self.paths.values()))
        self._reports: dict[tuple[str, str, str], ViewReport] = {}
        self._playing = threading.Event()
        self._shown = threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None  # that plays: one at most, however often the button is pressed
        for name, color in zip(self.paths, self._colors(), strict=False):
            line = camera_centers(self.paths[name].cam_from_world)
            segments = np.stack([line[:-1], line[1:]], axis=1)
            session.scene.add_line_segments(f"/path/{name}", segments, color, thickness=4.0, thickness_units="screen")
        controls = session.controls
        session.on(controls.step, lambda: self.show(int(value_of(controls.step, 1)) - 1))
        for handle in (controls.method, controls.occlusion):
            session.on(handle, lambda: self.show(int(value_of(controls.step, 1)) - 1))
        session.on(controls.play, self.toggle, "on_click")
        self.show(0)

    @staticmethod
    def _colors() -> tuple[tuple[int, int, int], ...]:
        return PATH_COLORS * 20

    def toggle(self) -> None:
        """Play, or pause."""
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
            begun = time.monotonic()
            self._shown.clear()
            slider.value = step + 1  # whose callback shows the step
            self._shown.wait(timeout=10)
            time.sleep(max(0.0, STEP_S - (time.monotonic() - begun)))
            step += 1

    def _ended(self, step: int) -> bool:
        """Whether there is nothing more to play; the next press of the button then starts anew."""
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
        """Show a step of all paths."""
        self.session.submit("path", SOON, self._steps(min(max(step, 0), self.length - 1)))

    def _steps(self, step: int) -> Iterator[None]:
        session = self.session
        opened = session.opened
        state = session.state
        camera = session.opened.camera
        look = session.shared.look(state.method, state.occlusion)
        for (name, played), color in zip(self.paths.items(), self._colors(), strict=False):
            key = (name, state.method, state.occlusion)
            if key not in self._reports:
                self._reports[key] = look.scorer.report(played.cam_from_world)
                yield
            report = self._reports[key]
            at = min(step, len(played) - 1)
            pose: Float = played.cam_from_world[at]
            seen = landmarks_seen(look.scorer, pose, session.shared.teller(state.occlusion))
            image, _ = opened.picture(pose, seen)
            session.scene.add_camera_frustum(
                f"/path/{name}/camera",
                session.fov,
                camera.width / camera.height,
                scale=2.0 * session.shared.mark_m,
                color=color,
                image=image,
                wxyz=quaternion_from_rotation(pose[:, :3].T),
                position=camera_centers(pose),
                thickness=3.0,
                thickness_units="screen",
                cast_shadow=False,
                receive_shadow=False,
            )
            score = float(report.score[at])
            told = f"**{plain(name)}**: score {score:.3g}, {report.n_visible[at]:,} landmarks"
            if played.localized is not None:
                told += LOCALIZED if played.localized[at] else LOST
            elif session.shared.is_probability(state.method) and score < state.threshold:
                told += LIKELY_LOST
            session.controls.path_told[name].content = told
            session.controls.path_pictures[name].image = image
            yield
        self._shown.set()
