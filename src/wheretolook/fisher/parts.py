"""Dividing rows among the cores of a CPU."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def run_in_parts(n_rows: int, rows_at_once: int, work: Callable[[slice], None], device: str = "cpu") -> None:
    """Call `work` with slices that cover `n_rows` rows.

    NumPy, PyTorch and Warp let go of Python's lock while they compute, so that threads use several cores.

    Args:
        n_rows: how many there are.
        rows_at_once: the most rows of a slice.
        work: on the CPU it is called from as many threads as there are cores, unless all rows are a single slice.
        device: where the work is done.
    """
    parts = [slice(start, min(start + rows_at_once, n_rows)) for start in range(0, n_rows, rows_at_once)]
    threads = min(len(parts), len(os.sched_getaffinity(0))) if device == "cpu" else 1
    if threads < 2:
        for part in parts:
            work(part)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, parts))
