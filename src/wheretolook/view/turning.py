"""How much a browser that draws slowly is to be shown while its camera moves."""

from __future__ import annotations

import math
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable

Point = tuple[float, float, float]

SLOW_S = 1 / 15
IN_A_ROW = 3
"""A browser tells its camera with each picture it draws, at most fifty times a second: so many so far apart, and it
draws slowly. Then it is shown less and less, until it draws smoothly or there is nothing to leave out."""
SMOOTH_S = 1 / 28  # the median of so many gaps
LAST = 5
LEAST = 0.02  # that the camera moves in a gap, of its distance: where it moves less, the hand is slow, not the browser
PAUSE_S = 2.0  # hardly a picture takes so long: the camera stood still
STILL_S = 0.3  # after which all is shown again


class Turning:
    """Calls `show` with 1 when the camera of a slow browser begins to move, with 2 up to `most` while that still is too
    much for it, and with 0 when the camera stands still. What was too much is not tried again.
    """

    def __init__(self, show: Callable[[int], None], most: int) -> None:
        self._show = show
        self._most = most
        self._lock = threading.Lock()
        self._moved = -PAUSE_S  # when the camera has; how much less is shown while it moves
        self._less = 0
        self._eye: Point = (0.0, 0.0, 0.0)  # where it was then, and the point it looked at
        self._target = self._eye
        self._slow_s = 0.0  # between pictures when it was found slow
        self._gaps_s: deque[float] = deque(maxlen=LAST)
        self._timer: threading.Timer | None = None  # one at most, while the camera moves

    def moved(self, eye: Point, target: Point) -> None:
        """The camera is at a place and looks at a point. While a hand turns it, a browser tells each camera twice."""
        with self._lock:
            way = math.dist(eye, self._eye) + math.dist(target, self._target)
            now = time.monotonic()
            if way == 0:
                return
            gap_s = now - self._moved
            self._moved = now
            self._eye = eye
            self._target = target
            if gap_s < PAUSE_S:
                self._gaps_s.append(gap_s if way > LEAST * math.dist(eye, target) else 0.0)
            changed = self._less < self._most and self._is_slow()
            if changed:
                self._less += 1
                self._slow_s = max(self._slow_s, statistics.median(self._gaps_s))
                self._gaps_s.clear()
            begins = self._less > 0 and self._timer is None
            if begins:
                self._wait(STILL_S + self._slow_s)  # the picture that is being drawn still shows all
            if changed or begins:
                self._show(self._less)  # nothing may come between, or less would be shown for good

    def _is_slow(self) -> bool:
        if self._less == 0:
            return len(self._gaps_s) >= IN_A_ROW and min(list(self._gaps_s)[-IN_A_ROW:]) > SLOW_S
        return len(self._gaps_s) == LAST and statistics.median(self._gaps_s) > SMOOTH_S

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
            self._gaps_s.clear()
            self._show(0)
