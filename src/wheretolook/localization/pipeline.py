"""Steps that run at the same time, each in a thread of its own, with few items under way."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

_END = object()
"""Passed through the steps after the last item."""


@dataclass(frozen=True)
class Step:
    """A step of a pipeline: the name its time is counted under, and a function of what the step before returned."""

    name: str
    run: Callable[[Any], Any]


def run_pipeline(
    items: Iterable[Any], steps: list[Step], seconds: dict[str, float] | None = None, depth: int = 2
) -> Iterator[Any]:
    """Pass items through steps; while one item is in the second step, the next is in the first.

    Steps that wait for a GPU, or that release Python's lock, overlap; items are read in a thread of their own. The time
    spent in each step is added to `seconds`, by the step's name. `depth` bounds the memory: how many items are under
    way for each step and for the source. Yields what the last step returns, in the order of the items; raises whatever
    a step or the source raised, and stops the other threads then.
    """
    iterator = iter(items)
    seconds = {} if seconds is None else seconds
    under_way: deque[Future[Any]] = deque()
    threads = [ThreadPoolExecutor(1) for _ in range(len(steps) + 1)]
    try:
        while True:
            while len(under_way) < depth * len(threads):
                future = threads[0].submit(next, iterator, _END)
                for thread, step in zip(threads[1:], steps, strict=True):
                    future = thread.submit(_run, step, future, seconds)
                under_way.append(future)
            item = under_way.popleft().result()
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
