"""Steps that run at the same time, each in a thread of its own, with bounded queues between them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from queue import Empty, Full, Queue
from typing import Any

_LOOK_S = 0.1  # how often a waiting thread looks whether to stop


@dataclass(frozen=True)
class Step:
    """One step of a pipeline.

    Args:
        name: under which its time is counted.
        run: takes an item of the step before, returns one for the step after.
    """

    name: str
    run: Callable[[Any], Any]


def run_pipeline(
    items: Iterable[Any], steps: list[Step], seconds: dict[str, float] | None = None, depth: int = 2
) -> Iterator[Any]:
    """Pass items through steps; while one item is in the second step, the next is in the first.

    Steps that wait for a GPU, or that release Python's lock, overlap. At most `depth` items wait before each step, so
    that memory is bounded.

    Args:
        items: read in the calling order, in a thread.
        steps: at least one.
        seconds: gets the time spent in each step added, by name.
        depth: length of each queue.

    Yields:
        What the last step returns, in the order of the items.

    Raises:
        BaseException: whatever a step or the source of items raised; the other threads are stopped then.
    """
    stop, seconds = threading.Event(), {} if seconds is None else seconds
    queues: list[Queue[_Message]] = [Queue(depth) for _ in range(len(steps) + 1)]
    threads = [threading.Thread(target=_feed, args=(items, queues[0], stop), daemon=True)]
    for step, source, target in zip(steps, queues[:-1], queues[1:], strict=True):
        threads.append(threading.Thread(target=_work, args=(step, source, target, stop, seconds), daemon=True))
    for thread in threads:
        thread.start()
    try:
        while (message := _get(queues[-1], stop)) is not None and not message.last:
            if message.error is not None:
                raise message.error
            yield message.item
    finally:
        stop.set()
        for thread in threads:
            thread.join()


@dataclass(frozen=True)
class _Message:
    item: Any = None
    error: BaseException | None = None
    last: bool = False


def _feed(items: Iterable[Any], target: Queue[_Message], stop: threading.Event) -> None:
    try:
        for item in items:
            _put(target, _Message(item), stop)
            if stop.is_set():
                return
        _put(target, _Message(last=True), stop)
    except BaseException as error:  # the caller's thread raises it
        _put(target, _Message(error=error), stop)


def _work(
    step: Step, source: Queue[_Message], target: Queue[_Message], stop: threading.Event, seconds: dict[str, float]
) -> None:
    while (message := _get(source, stop)) is not None:
        if message.last or message.error is not None:
            _put(target, message, stop)
            return
        try:
            start = time.perf_counter()
            item = step.run(message.item)
            seconds[step.name] = seconds.get(step.name, 0.0) + time.perf_counter() - start
            _put(target, _Message(item), stop)
        except BaseException as error:
            _put(target, _Message(error=error), stop)
            return


def _put(queue: Queue[_Message], message: _Message, stop: threading.Event) -> None:
    while not stop.is_set():
        try:
            return queue.put(message, timeout=_LOOK_S)
        except Full:
            continue


def _get(queue: Queue[_Message], stop: threading.Event) -> _Message | None:
    while not stop.is_set():
        try:
            return queue.get(timeout=_LOOK_S)
        except Empty:
            continue
    return None
