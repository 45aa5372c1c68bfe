"""Reduce what a slow browser draws while its camera moves."""

from __future__ import annotations

import math
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable

Point = tuple[float, float, float]

SLOW_S = 1 / 15
N_SLOW = 3
"""A browser sends its camera with each image it draws, at most 50 times a second. This many consecutive gaps longer
than SLOW_S mean that it draws slowly."""
SMOOTH_S = 1 / 28
N_MEDIAN = 5
"""Detail is reduced further while the median of this many gaps is longer than SMOOTH_S."""
MIN_MOTION = 0.02  # camera motion in a gap over the viewing distance; below, the hand is slow, not the browser
PAUSE_S = 2.0  # a longer gap means that the camera stood still
STILL_S = 0.3  # after it, everything is shown again


class LevelOfDetail:
    """Calls `show` with a level from 1 to `max_level` while the camera of a slow browser moves, else with 0.

    The level rises until the browser draws smoothly, and later movements begin with the last level.
    """

    def __init__(self, show: Callable[[int], None], max_level: int) -> None:
        self._show = show
        self._max_level = max_level
        self._level = 0  # while the camera moves
        self._lock = threading.Lock()
        self._moved = -PAUSE_S  # time of the last motion
        self._eye: Point = (0.0, 0.0, 0.0)
        self._target = self._eye
        self._slow_s = 0.0  # median gap when the level was raised
        self._gaps_s: deque[float] = deque(maxlen=N_MEDIAN)
        self._timer: threading.Timer | None = None  # runs while the camera moves

    def moved(self, eye: Point, target: Point) -> None:
        """Handle a camera pose sent by the browser; it sends each pose twice while a hand moves the camera."""
        with self._lock:
            motion = math.dist(eye, self._eye) + math.dist(target, self._target)
            if motion == 0:
                return
            now = time.monotonic()
            gap_s = now - self._moved
            self._moved = now
            self._eye = eye
            self._target = target
            if gap_s < PAUSE_S:
                self._gaps_s.append(gap_s if motion > MIN_MOTION * math.dist(eye, target) else 0.0)
            raised = self._level < self._max_level and self._is_slow()
            if raised:
                self._level += 1
                self._slow_s = max(self._slow_s, statistics.median(self._gaps_s))
                self._gaps_s.clear()
            begins = self._level > 0 and self._timer is None
            if begins:
                self._start_timer(STILL_S + self._slow_s)  # the image being drawn still shows everything
            if raised or begins:
                self._show(self._level)  # within the lock: otherwise the reset could precede it

    def _is_slow(self) -> bool:
        if self._level == 0:
            return len(self._gaps_s) >= N_SLOW and min(list(self._gaps_s)[-N_SLOW:]) > SLOW_S
        return len(self._gaps_s) == N_MEDIAN and statistics.median(self._gaps_s) > SMOOTH_S

    def _start_timer(self, seconds: float) -> None:
        self._timer = threading.Timer(seconds, self._reset_if_still)
        self._timer.daemon = True
        self._timer.start()

    def _reset_if_still(self) -> None:
        with self._lock:
            remaining_s = self._moved + STILL_S - time.monotonic()
            if remaining_s > 0:
                self._start_timer(remaining_s)
                return
            self._timer = None
            self._gaps_s.clear()
            self._show(0)
