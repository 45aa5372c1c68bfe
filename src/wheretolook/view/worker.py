"""Single-threaded job queue of three urgencies; newer jobs replace older ones of the same client and kind."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass

NOW = 0
SOON = 1
LATER = 2
"""Urgencies: a view turned by hand, a clicked location, the floor."""

QUIET_S = 0.4
PATIENCE_S = 4.0
"""A LATER job does not start within QUIET_S of a NOW job, since the next one would wait for its step, unless no LATER
job has run for PATIENCE_S."""

CLICK_PATIENCE_S = 1.0  # a SOON job precedes NOW jobs if none has run for this long

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
                start = min(self._last_run[NOW] + QUIET_S, self._last_run[LATER] + PATIENCE_S)
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
