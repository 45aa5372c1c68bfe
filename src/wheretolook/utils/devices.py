"""Which device kernels and networks run on."""

from __future__ import annotations


def resolve_device(device: str) -> str:
    """A device's name, with "auto" resolved: "cuda" if there is a GPU, else "cpu". Finding out loads PyTorch."""
    if device != "auto":
        return device
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"
