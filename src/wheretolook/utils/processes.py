"""Spreads work over processes, which read a few items ahead of the results."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from types import TracebackType
from typing import TypeVar

from wheretolook.utils.errors import WorkerError
from wheretolook.utils.workers import end_with_parent, in_main_thread, spawning, use_one_core

Item = TypeVar("Item")
Result = TypeVar("Result")


class Processes:
    """`workers` processes of one thread each, spawned when first needed and ended with the block; 1 is this process."""

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Processes:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown()

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Generator[Result, None, None]:
        """Apply a function, defined at the top level of a module, to items. Yields results in their order.

        Raises WorkerError if a process was killed.
        """
        if self.workers <= 1:
            yield from map(function, items)
            return
        if self._pool is None:  # here, since the thread that begins to use it starts the processes
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self.workers, context, _start_worker, (in_main_thread(),))
        source = iter(items)
        pending = deque[Future[Result]]()
        try:
            while True:
                for item in islice(source, 4 * self.workers - len(pending)):
                    with spawning():
                        pending.append(self._pool.submit(function, item))
                if not pending:
                    return
                yield pending.popleft().result()
        except BrokenProcessPool as error:
            problem = "a process was killed, probably for lack of memory"
            fix = "Use fewer workers (--label.workers, or --workers) and run again."
            raise WorkerError(problem, value=f"{self.workers} workers", fix=fix) from error
        finally:
            for future in pending:
                future.cancel()


def _start_worker(of_main_thread: bool) -> None:
    end_with_parent(of_main_thread)
    use_one_core()
