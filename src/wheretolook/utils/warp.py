"""Starts Warp, and copies points to a device."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes.util import find_library
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from wheretolook.utils.errors import ConfigError


@cache  # looking for a driver takes 14 ms
def start_warp(device: str = "cpu") -> str:
    """Initialize Warp without its banner, and return the full name of a device, such as "cuda:0" for "cuda".

    Called when something is built on a device, never on import, so that worker processes start Warp themselves. Raises
    ConfigError if this machine has no such device.
    """
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    try:
        with _without_driver_warning():
            wp.init()
        kernels = Path(str(wp.config.kernel_cache_dir))
        if not os.access(kernels, os.W_OK) and not any(kernels.glob("wp_wheretolook*")):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(kernels))
        found = wp.get_device(device)
        if found.is_cuda and found.is_mempool_supported:
            # bytes of freed memory that a process keeps: each synchronization releases the rest, which takes time
            wp.set_mempool_release_threshold(found, 1 << 29)
        return str(found)
    except OSError as error:
        fix = "Set WARP_CACHE_PATH to a folder that can be written."
        raise ConfigError("kernels cannot be compiled here", path=error.filename, fix=fix) from None
    except (ValueError, RuntimeError) as error:
        available = ", ".join(str(found) for found in wp.get_devices())
        raise ConfigError("no such device", value=device, fix=f"Use one of: {available}") from error


@contextmanager
def _without_driver_warning() -> Iterator[None]:
    """Hide the warning of Warp's native library about a missing GPU, which would interrupt progress bars."""
    if find_library("cuda") is not None:
        yield
        return
    sys.stderr.flush()
    stderr = os.dup(2)
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(null)


def vec3_array(points: ArrayLike, device: str) -> wp.array:
    """Copy points (N, 3) to a float32 array of vectors on a device."""
    return wp.array(np.ascontiguousarray(points, dtype=np.float32).reshape(-1, 3), dtype=wp.vec3, device=device)


class Staging:
    """Page-locked memory through which arrays are copied from a GPU, about ten times as fast as without.

    For one thread; the memory is kept from call to call.
    """

    def __init__(self) -> None:
        self._memory: Any = None

    def download(self, array: Any) -> NDArray[Any]:
        """Return the content of a Warp array; it is overwritten by the next call."""
        if array.device.is_cpu:
            return np.asarray(array.numpy())
        n_bytes = array.size * wp.types.type_size_in_bytes(array.dtype)
        if self._memory is None or self._memory.size < n_bytes:
            self._memory = wp.empty(n_bytes, dtype=wp.uint8, device="cpu", pinned=True)
        target: Any = wp.array(ptr=self._memory.ptr, dtype=array.dtype, shape=array.shape, device="cpu")
        wp.copy(target, array)
        wp.synchronize_stream(wp.get_stream(array.device))
        return np.asarray(target.numpy())
