"""The local engine: labels shards in worker processes of this machine."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from wheretolook.localization.shard import LabelledShard, Shard, ShardWorker
from wheretolook.utils.processes import WorkerPool, worker_number

_worker: ShardWorker | None = None


def run_local(shards: Sequence[Shard], workers: int) -> Iterator[tuple[Shard, LabelledShard]]:
    """Label shards in worker processes, begun in this order, and yield them as they are finished.

    Raises what a worker raises, and WorkerError if workers are killed repeatedly.
    """
    with WorkerPool(min(workers, len(shards))) as pool:
        yield from pool.map_unordered(_label_shard, shards)


def _label_shard(shard: Shard) -> LabelledShard:
    global _worker
    _worker = _worker or ShardWorker(worker_number())
    return _worker.label(shard.job, shard.rows)
