"""One thread that computes for all who look: the most urgent first, and of what somebody asks for again, the newest."""

from __future__ import annotations

import itertools
import logging
import math
import threading
import time
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field

NOW = 0
SOON = 1
LATER = 2
"""Urgency of work: a view turned by hand, a place clicked, a floor that fills."""

QUIET_S = 0.4
PATIENCE_S = 4.0
"""So long after a view was turned nothing is begun that can wait, as the next turn would have to wait for its step;
unless for so long nothing of that kind was done: where many look, somebody always turns."""

CLICK_PATIENCE_S = 1.0
"""After so long without a place being done, one goes before turns: a client that floods turns without end."""

_log = logging.getLogger(__name__)


@dataclass(order=True)
class _Job:
    urgency: int
    turn: int
    key: tuple[Hashable, Hashable] = field(compare=False)
    steps: Iterator[object] = field(compare=False)
    failed: Callable[[Exception], None] = field(compare=False)


class Worker:
    """Computes jobs, iterators each, one step at a time, in a thread of this name.

    Scorers are not for several threads, and two cores have no more to give. Between two steps a more urgent job goes
    first; jobs as urgent take turns, so that nobody waits for all of another's floor. While somebody turns a view,
    floors wait. None waits for ever. A job that raises is told so, by `failed`, and ends; others go on.
    """

    def __init__(self, name: str = "scores") -> None:
        self._jobs: dict[tuple[Hashable, Hashable], _Job] = {}
        self._turns = itertools.count()
        self._wake = threading.Condition()
        self._stopped = False
        self._done = dict.fromkeys((NOW, SOON, LATER), -math.inf)  # when one as urgent was done last
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(
        self,
        owner: Hashable,
        kind: Hashable,
        urgency: int,
        steps: Iterator[object],
        failed: Callable[[Exception], None],
    ) -> None:
        """Do a job of an owner, in place of the one of that kind that is still to be done."""
        with self._wake:
            self._jobs[owner, kind] = _Job(urgency, next(self._turns), (owner, kind), steps, failed)
            self._wake.notify()

    def forget(self, owner: Hashable) -> None:
        """Drop all jobs of an owner."""
        with self._wake:
            for key in [key for key in self._jobs if key[0] == owner]:
                del self._jobs[key]

    def stop(self, wait: bool = True) -> None:
        """End after the step that is being done; wait for it, unless told not to."""
        with self._wake:
            self._stopped = True
            self._wake.notify()
        if wait:
            self._thread.join(timeout=10)

    def _run(self) -> None:
        while True:
            with self._wake:
                while not self._jobs and not self._stopped:
                    self._wake.wait()
                if self._stopped:
                    return
                job = self._next()
                now = time.monotonic()
                until = min(self._done[NOW] + QUIET_S, self._done[LATER] + PATIENCE_S) - now
                if job.urgency == LATER and until > 0:
                    self._wake.wait(until)
                    continue
            self._step(job)
            self._done[job.urgency] = time.monotonic()

    def _next(self) -> _Job:
        """The most urgent job, or a less urgent one whose kind has waited for too long."""
        for urgency, patience_s in ((SOON, CLICK_PATIENCE_S), (LATER, PATIENCE_S)):
            if time.monotonic() - self._done[urgency] > patience_s:
                waiting = [job for job in self._jobs.values() if job.urgency == urgency]
                if waiting:
                    return min(waiting)
        return min(self._jobs.values())

    def _step(self, job: _Job) -> None:
        goes_on = False
        try:
            next(job.steps)
            goes_on = True
        except StopIteration:
            pass
        except Exception as error:  # whatever one job raises, the others go on
            _log.debug("a job failed: %s", job.key, exc_info=error)
            try:
                job.failed(error)
            except Exception:
                _log.exception("what failed could not be told")
        with self._wake:
            if self._jobs.get(job.key) is job:
                if goes_on:
                    job.turn = next(self._turns)
                else:
                    del self._jobs[job.key]
