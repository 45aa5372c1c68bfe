"""The local engine: labels shards in worker processes of this machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from wheretolook.localization.shard import LabelledShard, Shard, ShardWorker
from wheretolook.utils.processes import WorkerPool, report_progress, worker_number

_worker: ShardWorker | None = None


def run_local(
    shards: Sequence[Shard], workers: int, tick: Callable[[int], None] = lambda n: None
) -> Iterator[tuple[Shard, LabelledShard]]:
    """Label shards in worker processes, begun in this order, and yield them as they are finished.

    `tick` gets the number of viewpoints just finished, negative if a worker was killed and they are labelled again.
    Raises what a worker raises, and WorkerError if workers are killed repeatedly.
    """
    finished = 0
    in_flight = 0
    shown = 0

    def show(now: int) -> None:
        nonlocal in_flight, shown
        in_flight = now
        tick(finished + in_flight - shown)
        shown = finished + in_flight

    with WorkerPool(min(workers, len(shards))) as pool:
        for shard, labelled in pool.map_unordered(_label_shard, shards, on_progress=show):
            finished += len(shard.rows)
            show(in_flight)
            yield shard, labelled


def _label_shard(shard: Shard) -> LabelledShard:
    global _worker
    _worker = _worker or ShardWorker(worker_number())
    return _worker.label(shard.job, shard.rows, report_progress)
