"""Selects the device to compute on."""

from __future__ import annotations

import ctypes
from functools import cache

from wheretolook.utils.errors import ConfigError


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
