"""The local engine: labels shards in processes of this machine. A process that dies is replaced, its shard redone."""

from __future__ import annotations

import multiprocessing
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from wheretolook.localization.shard import LabelledShard, Shard, ShardWorker
from wheretolook.utils.errors import WorkerError
from wheretolook.utils.workers import end_with_parent, in_main_thread, spawning

MAX_DEATHS = 3
"""Labelling ends with an error when a shard's worker was killed this many times."""


@dataclass(eq=False)
class _Worker:
    process: BaseProcess
    pipe: Connection
    shard: Shard | None = None
    ticked: int = 0


def run_local(
    shards: Sequence[Shard], workers: int, tick: Callable[[int], None] = lambda n: None
) -> Iterator[tuple[Shard, LabelledShard]]:
    """Label shards in processes, begun in this order, and yield them as they are finished.

    `tick` is called with the number of viewpoints just finished, negative when a worker died and they are redone.
    Raises what a worker raises, and a WorkerError if a shard's worker was killed `MAX_DEATHS` times.
    """
    waiting = deque(shards)
    deaths = Counter[Shard]()
    team: list[_Worker] = []
    try:
        with spawning():
            for number in range(min(workers, len(shards))):
                team.append(_start(number))
        for worker in team:
            _give(worker, waiting)
        while any(worker.shard is not None for worker in team):
            by_pipe = {worker.pipe: worker for worker in team if worker.shard is not None}
            for pipe in wait(list(by_pipe)):
                worker = by_pipe[pipe]  # type: ignore[index]
                shard = worker.shard
                assert shard is not None
                try:
                    message = worker.pipe.recv()
                except (EOFError, OSError):  # killed, perhaps in the middle of a message: its end of the pipe is closed
                    tick(-worker.ticked)
                    deaths[shard] += 1
                    if deaths[shard] == MAX_DEATHS:
                        problem = f"{MAX_DEATHS} labelling processes were killed at the same viewpoints"
                        problem = f"{problem}, probably for lack of memory"
                        value = f"{workers} workers"
                        fix = "Lower label.workers and run again: finished shards are kept."
                        raise WorkerError(problem, path=shard.job.mesh, value=value, fix=fix) from None
                    waiting.appendleft(shard)
                    worker.process.join()
                    number = team.index(worker)
                    with spawning():
                        team[number] = _start(number)
                    _give(team[number], waiting)
                    continue
                if isinstance(message, int):
                    worker.ticked += message
                    tick(message)
                elif isinstance(message, BaseException):
                    raise message
                else:
                    _give(worker, waiting)
                    yield shard, message
    finally:
        for worker in team:
            worker.process.kill()
        for worker in team:
            worker.process.join()


def _start(number: int) -> _Worker:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, number, in_main_thread()), daemon=True)
    process.start()
    theirs.close()  # the child holds the only copy then, so its death closes the pipe
    return _Worker(process, ours)


def _give(worker: _Worker, waiting: deque[Shard]) -> None:
    """Hand the next shard to a worker, if there is one."""
    worker.shard = waiting.popleft() if waiting else None
    worker.ticked = 0
    if worker.shard is not None:
        with suppress(OSError):  # the worker has died, which the next read from its pipe will show
            worker.pipe.send((worker.shard.job, worker.shard.rows))


def _work(pipe: Connection, number: int, of_main_thread: bool) -> None:
    end_with_parent(of_main_thread)
    worker: ShardWorker | None = None
    while True:
        try:
            job, rows = pipe.recv()
        except EOFError:
            return
        try:
            worker = worker or ShardWorker(number)
            pipe.send(worker.label(job, rows, pipe.send))
        except BaseException as error:
            pipe.send(error)
