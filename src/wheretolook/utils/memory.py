"""Available memory, so that what would not fit is rejected at once."""

from __future__ import annotations

import os
from pathlib import Path


def available_bytes() -> int:
    """Return the memory available without swapping, in bytes; all of it where the system does not report it."""
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return int(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))


def fitting(bytes_each: int) -> int:
    """Return how many items of `bytes_each` fit into 80 % of the available memory."""
    return available_bytes() * 4 // 5 // bytes_each
