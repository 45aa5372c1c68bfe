"""Runs the steps of a pipeline concurrently, each in its own thread, on few items at a time."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

_END = object()
"""Marks the end of the items."""


@dataclass(frozen=True)
class Step:
    """A step of a pipeline: a name for its time, and a function of the previous step's result."""

    name: str
    run: Callable[[Any], Any]


def run_pipeline(
    items: Iterable[Any], steps: list[Step], seconds: dict[str, float] | None = None, depth: int = 2
) -> Iterator[Any]:
    """Pass items through steps and yield the results of the last step in the order of the items.

    Steps that wait for a GPU or release the interpreter lock overlap; items are read in a thread of their own. The
    seconds spent in each step are added to `seconds`. `depth` is the number of items in flight for each step and for
    the source. Errors of a step or the source are raised here, and end the other threads.
    """
    iterator = iter(items)
    seconds = {} if seconds is None else seconds
    in_flight: deque[Future[Any]] = deque()
    threads = [ThreadPoolExecutor(1) for _ in range(len(steps) + 1)]
    try:
        while True:
            while len(in_flight) < depth * len(threads):
                future = threads[0].submit(next, iterator, _END)
                for thread, step in zip(threads[1:], steps, strict=True):
                    future = thread.submit(_run, step, future, seconds)
                in_flight.append(future)
            item = in_flight.popleft().result()
            if item is _END:
                return
            yield item
    finally:
        for thread in threads:
            thread.shutdown(wait=False, cancel_futures=True)
        for thread in threads:
            thread.shutdown()


def _run(step: Step, source: Future[Any], seconds: dict[str, float]) -> Any:
    item = source.result()
    if item is _END:
        return item
    start = time.perf_counter()
    item = step.run(item)
    seconds[step.name] = seconds.get(step.name, 0.0) + time.perf_counter() - start
    return item
