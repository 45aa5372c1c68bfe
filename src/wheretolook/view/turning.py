"""When a browser that draws slowly is to be shown less: while its camera moves."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

SLOW_S, IN_A_ROW = 1 / 15, 3
"""A browser tells its camera with each picture it draws, at most fifty times a second: so many so far apart, and it
draws slowly."""
PAUSE_S = 1.0  # no picture takes so long: the camera stood still
STILL_S = 0.3  # after which all is shown again


class Turning:
    """Calls `thin` with True when the camera of a slow browser begins to move, and with False when it stands still."""

    def __init__(self, thin: Callable[[bool], None]) -> None:
        self._thin, self._lock = thin, threading.Lock()
        self._moved, self._slow = -PAUSE_S, 0  # when the camera has, and how many slow pictures in a row
        self._timer: threading.Timer | None = None  # one at most, while the camera moves

    def moved(self) -> None:
        """The camera has moved."""
        with self._lock:
            now = time.monotonic()
            gap_s, self._moved = now - self._moved, now
            if self._slow < IN_A_ROW:
                self._slow = self._slow + 1 if SLOW_S < gap_s < PAUSE_S else 0
            if self._slow < IN_A_ROW or self._timer is not None:
                return
            self._wait(STILL_S)
        self._thin(True)

    def _wait(self, seconds: float) -> None:
        self._timer = threading.Timer(seconds, self._look)
        self._timer.daemon = True
        self._timer.start()

    def _look(self) -> None:
        with self._lock:
            rest_s = self._moved + STILL_S - time.monotonic()
            if rest_s > 0:
                self._wait(rest_s)
                return
            self._timer = None
        self._thin(False)
