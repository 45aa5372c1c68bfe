"""Available memory, so that what would not fit is rejected at once, and smaller batches where a GPU's is exhausted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import psutil

from wheretolook.utils.logs import LOG


def available_bytes() -> int:
    """Return the memory available without swapping, in bytes."""
    return int(psutil.virtual_memory().available)


def fitting(bytes_each: int) -> int:
    """Return how many items of `bytes_each` fit into 80 % of the available memory."""
    return available_bytes() * 4 // 5 // bytes_each


def halving(run: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a function of a batch that runs its halves, one after the other, where a GPU's memory does not suffice.

    `run` returns one result for each item of a batch, which can be sliced: a sequence or array, of halves a list.
    """

    def run_or_halve(batch: Any) -> Any:
        try:
            return run(batch)
        except RuntimeError as error:  # of PyTorch, or of Warp
            text = str(error).lower()
            if len(batch) < 2 or not ("out of memory" in text or "failed to allocate" in text):
                raise
        import torch

        torch.cuda.empty_cache()
        half = len(batch) // 2
        LOG.warning("GPU memory does not suffice for %d views at a time; %d follow at a time", len(batch), half)
        return [*run_or_halve(batch[:half]), *run_or_halve(batch[half:])]

    return run_or_halve
