"""Devices, free memory, and work in parts over threads."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, TypeVar

from wheretolook.utils.errors import ConfigError
from wheretolook.utils.texts import LOG


def usable_device(device: str) -> str:
    """Return a usable device: the given one, or for "auto" a GPU if there is one, else the CPU.

    Where there is no GPU, the answer comes without loading PyTorch. Raises ConfigError if there is no such device.
    """
    check_device_name(device)
    if device == "cpu":
        return device
    count = _driver_gpus() and _torch_gpus()
    if device == "auto":
        return "cuda" if count else "cpu"
    if _driver_gpus() == 0:
        fix = "Use --device cpu, or --device auto for a GPU only where there is one."
        raise ConfigError("there is no GPU that CUDA can use", value=device, fix=fix)
    if count == 0:
        fix = "Install PyTorch for CUDA with `make setup TORCH=cuda`, or use --device cpu."
        raise ConfigError("PyTorch is built for the CPU, or for a newer driver", value=device, fix=fix)
    if int(device.partition(":")[2] or 0) >= count:
        raise ConfigError("there is no such GPU", value=device, fix=f"There are {count}: cuda:0 is the first.")
    return device


def check_device_name(device: str) -> None:
    """Raise ConfigError unless it is the name of a device."""
    kind, colon, index = device.partition(":")
    if device not in ("cpu", "auto", "cuda") and not (kind == "cuda" and colon and index.isdecimal()):
        raise ConfigError("unknown device", value=device, fix="Use auto, cpu, cuda, or cuda:1 for the second GPU.")


@cache
def _driver_gpus() -> int:
    """Count the GPUs that NVIDIA's driver shows to this process; asking it directly takes milliseconds."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
        count = ctypes.c_int()
        found = driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0
    except (OSError, AttributeError):
        return 0
    return count.value if found else 0


@cache
def _torch_gpus() -> int:
    import torch

    return torch.cuda.device_count() if torch.cuda.is_available() else 0


def available_bytes() -> int:
    """Return the memory available without swapping, in bytes; a robot without psutil is taken for a Linux machine."""
    try:
        import psutil
    except ImportError:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES")
    return int(psutil.virtual_memory().available)


def fitting(bytes_each: int) -> int:
    """Return how many items of `bytes_each` fit into 80 % of the available memory."""
    return available_bytes() * 4 // 5 // bytes_each


def run_halving(run: Callable[[Any], Any], batch: Any) -> Any:
    """Run a function of a batch on it, or on its halves one after the other where a GPU's memory does not suffice.

    `run` returns one result for each item of a batch, which can be sliced: a sequence or array, of halves a list.
    """
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
    return [*run_halving(run, batch[:half]), *run_halving(run, batch[half:])]


Item = TypeVar("Item")
Result = TypeVar("Result")


def in_threads(work: Callable[[Item], Result], items: Sequence[Item], threads: int) -> Iterator[Result]:
    """Yield the results of `work` for each item in their order, computed by so many threads, or here if one is enough.

    Raises what a thread raises.
    """
    if threads < 2 or len(items) < 2:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(work, items)
