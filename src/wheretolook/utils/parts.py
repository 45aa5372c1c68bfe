"""Divides work on rows among the cores of a CPU."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from wheretolook.utils.system import cores

Item = TypeVar("Item")
Result = TypeVar("Result")


def run_in_parts(n_rows: int, rows_at_once: int, work: Callable[[slice], None], device: str = "cpu") -> None:
    """Call `work` with slices of at most `rows_at_once` rows that cover `n_rows` rows.

    On the CPU, `work` is called from as many threads as there are cores, unless there is a single slice only. NumPy,
    PyTorch and Warp release Python's lock while they compute, so that the threads use several cores.
    """
    parts = [slice(start, min(start + rows_at_once, n_rows)) for start in range(0, n_rows, rows_at_once)]
    threads = min(len(parts), cores()) if device == "cpu" else 1
    list(in_threads(work, parts, threads))


def in_threads(work: Callable[[Item], Result], items: Sequence[Item], threads: int) -> Iterator[Result]:
    """Yield the results of `work` for each item in their order, computed by so many threads, or here if one is enough.

    Raises what a thread raises.
    """
    if threads < 2 or len(items) < 2:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(work, items)
