"""How much memory there is, to refuse at once what would not fit."""

from __future__ import annotations

import os
from pathlib import Path


def available_bytes() -> int:
    """Memory this machine can give without swapping; all it has, where the system does not say."""
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return int(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))


def fitting(bytes_each: int) -> int:
    """How many things of so many bytes fit into 80 % of the memory that is available."""
    return available_bytes() * 4 // 5 // bytes_each
